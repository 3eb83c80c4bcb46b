// Registers of the tile kernels as vector extensions: of 32 bytes for AVX2 with FMA, of 16 for SSE2, NEON or whatever
// the processor has. See packs.h.
#pragma once

#include "simd/vectors.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct Register {
#if defined(__AVX2__)
  static constexpr int kBytes = 32, kParts = sizeof(T) == 8 ? 1 : 2;
#else
  static constexpr int kBytes = 16, kParts = 2;
#endif
  static constexpr int kLanes = Vectors<T, kBytes>::kCount;
  using Vector = typename Vectors<T, kBytes>::Real;
  using Mask = typename Vectors<T, kBytes>::Int;

  static BEAGS_INLINE Vector broadcast(T value) { return value - Vector{}; }  // x - 0 is x, bit by bit
  static BEAGS_INLINE Vector load(const T* from) {
    Vector value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
  }
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return fused(a, b, c); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return smaller(a, b); }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return a < b; }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return a <= b; }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return a == b; }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return a & b; }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return a | b; }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return a & ~b; }
  static BEAGS_INLINE bool any(Mask mask) { return any_lane(mask); }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) { return BEAGS_ISA::select(mask, yes, no); }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return (Vector)(mask & (Mask)value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) { return (Vector)(~mask & (Mask)value); }
  // Returns value 2^i; i lies in the lowest bits of `shifted`.
  static BEAGS_INLINE Vector scale(Vector value, Vector shifted) {
    return (Vector)((Mask)value + ((Mask)shifted << 23));
  }
  // Sets out[i] to the sum of the lanes of v[i], i = 0..3; always in the same order.
  static BEAGS_INLINE void sum4(const Vector* v, T* out) {
    if constexpr (sizeof(T) == 4) {
      const Vector sums = add_pairs(add_pairs(v[0], v[1]), add_pairs(v[2], v[3]));
      Real4F halves[2] = {};
      __builtin_memcpy(halves, &sums, sizeof sums);
      if constexpr (kLanes == 8) halves[0] = halves[0] + halves[1];
      __builtin_memcpy(out, halves, sizeof halves[0]);
    } else {
      for (int i = 0; i < 4; ++i) {
        out[i] = v[i][0] + v[i][1];
        if constexpr (kLanes == 4) out[i] = out[i] + (v[i][2] + v[i][3]);
      }
    }
  }
};

}  // namespace BEAGS_ISA
}  // namespace beags
