// Makes random bits that depend on their counters alone, as occupancy/sampling.py, and the directions that they mean.
// Included once for each instruction set.
#pragma once

#include "ops/hash.h"
#include "ops/lanes.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

typedef uint64_t Words __attribute__((vector_size(32)));

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

// Computes cosine and sine of angle / 2^24 turns, 0 <= angle < 2^24. Quarter turns are taken off exactly, in integers.
BEAGS_INLINE void cos_sin(IntF angle, RealF& cosine, RealF& sine) {
  const RealF zero = {};
  const IntF quarter = (angle + (1 << 21)) >> 22;
  const RealF x = to_real(angle - (quarter << 22)) * 3.74507029e-7f;  // 2 pi / 2^24; |x| <= pi / 4
  const RealF x2 = x * x;
  RealF s = zero + 1.0f / 362880;
  s = fma(s, x2, zero - 1.0f / 5040);
  s = fma(s, x2, zero + 1.0f / 120);
  s = fma(s, x2, zero - 1.0f / 6);
  s = fma(s * x2, x, x);
  RealF c = zero + 1.0f / 40320;
  c = fma(c, x2, zero - 1.0f / 720);
  c = fma(c, x2, zero + 1.0f / 24);
  c = fma(c, x2, zero - 0.5f);
  c = fma(c, x2, zero + 1.0f);
  const IntF odd = -(quarter & 1);
  const IntF sign_c = ((quarter + 1) & 2) << 30, sign_s = (quarter & 2) << 30;
  cosine = (RealF)((IntF)select(odd, s, c) ^ sign_c);
  sine = (RealF)((IntF)select(odd, c, s) ^ sign_s);
}
BEAGS_INLINE void cos_sin(IntD angle, RealD& cosine, RealD& sine) {
  for (int i = 0; i < 4; ++i) {
    const double x = static_cast<double>(angle[i]) * 3.745070282923929e-07;
    cosine[i] = cos(x);
    sine[i] = sin(x);
  }
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
