// Makes random bits that depend on their counters alone, as occupancy/sampling.py. Included once for each instruction
// set.
#pragma once

#include "simd/hash.h"
#include "simd/lanes.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

// Applies the SplitMix64 finaliser, as occupancy/sampling.py.
template <class W>
BEAGS_INLINE W mix(W word) {
  word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9u;
  word = (word ^ word >> 27) * 0x94D049BB133111EBu;
  return word ^ word >> 31;
}

// One random number for each lane and sample: 24 bits for the radius, 24 for the angle.
template <class T>
struct Counter;

template <>
struct Counter<float> {
  Words even, odd;  // lanes 0, 2, .. and 1, 3, ..
  explicit Counter(const uint64_t* state) {
    for (int i = 0; i < 4; ++i) {
      even[i] = state[2 * i];
      odd[i] = state[2 * i + 1];
    }
  }
  BEAGS_INLINE void next(IntF& radial, IntF& angle) {
    typedef uint32_t Halves __attribute__((vector_size(32)));
    const Words a = mix(even), b = mix(odd);
    radial = (IntF)((Halves)(a >> 32 | (b >> 32 << 32)) >> 8);
    angle = (IntF)((Halves)((a << 32 >> 32) | b << 32) >> 8);
    even += kGolden;
    odd += kGolden;
  }
};

template <>
struct Counter<double> {
  Words words;
  explicit Counter(const uint64_t* state) {
    for (int i = 0; i < 4; ++i) words[i] = state[i];
  }
  BEAGS_INLINE void next(IntD& radial, IntD& angle) {
    const Words word = mix(words);
    radial = (IntD)(word >> 40);
    angle = (IntD)(word << 32 >> 40);
    words += kGolden;
  }
};

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
