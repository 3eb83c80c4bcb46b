// Defines what the ops' kernels compute on vectors of 32 bytes, 8 float32 or 4 float64 lanes (vectors.h), on any
// instruction set.
#pragma once

#include "simd/vectors.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

typedef uint64_t Words __attribute__((vector_size(32)));

template <class T>
using Lanes = beags::BEAGS_ISA::Vectors<T, 32>;

using RealF = Lanes<float>::Real;
using IntF = Lanes<float>::Int;
using RealD = Lanes<double>::Real;
using IntD = Lanes<double>::Int;

using beags::BEAGS_ISA::fused;
using beags::BEAGS_ISA::root;
using beags::BEAGS_ISA::select;

BEAGS_INLINE RealF fma(RealF a, RealF b, RealF c) { return fused(a, b, c); }
BEAGS_INLINE RealD fma(RealD a, RealD b, RealD c) { return fused(a, b, c); }
BEAGS_INLINE RealF sqrt(RealF x) { return root(x); }
BEAGS_INLINE RealD sqrt(RealD x) { return root(x); }

// Returns NaN where x is not finite, else 0.
template <class R>
BEAGS_INLINE R nan_unless_finite(R x) {
  return x - x;
}

// Rounds towards 0; lanes that do not fit hold any number.
BEAGS_INLINE IntF to_int(RealF x) { return __builtin_convertvector(x, IntF); }
BEAGS_INLINE IntD to_int(RealD x) { return __builtin_convertvector(x, IntD); }
BEAGS_INLINE RealF to_real(IntF x) { return __builtin_convertvector(x, RealF); }
BEAGS_INLINE RealD to_real(IntD x) { return __builtin_convertvector(x, RealD); }

// Floors, for |x| < 2^31; other lanes hold any number, so that their sums must wrap.
BEAGS_INLINE IntF wrapping_sum(IntF a, IntF b) { return (IntF)((Lanes<float>::Bits)a + (Lanes<float>::Bits)b); }
BEAGS_INLINE IntD wrapping_sum(IntD a, IntD b) { return (IntD)((Lanes<double>::Bits)a + (Lanes<double>::Bits)b); }
template <class R>
BEAGS_INLINE auto floor_to_int(R x) {
  const auto whole = to_int(x);
  return wrapping_sum(whole, to_real(whole) > x);
}

// Returns e^x to 2 units in the last place; 0 below -87, infinity above 88. simd.h's exp2 is another polynomial, less
// accurate and faster.
BEAGS_INLINE RealF exponential(RealF x) {
  const RealF zero = {};
  const IntF tiny = x < -87.0f, huge = x > 88.0f;
  x = select(tiny | huge, zero, x);
  const RealF shifted = x * 1.44269504f + 12582912.0f;  // 1.5 * 2^23: the lowest bits now hold x / ln 2, rounded
  const RealF i = shifted - 12582912.0f;
  // ln 2 in two parts, the first short enough for exact products; |r| <= ln 2 / 2
  const RealF r = fma(i, zero - 1.42860677e-6f, fma(i, zero - 0.693145752f, x));
  RealF p = zero + 1.0f / 5040;
  p = fma(p, r, zero + 1.0f / 720);
  p = fma(p, r, zero + 1.0f / 120);
  p = fma(p, r, zero + 1.0f / 24);
  p = fma(p, r, zero + 1.0f / 6);
  p = fma(p, r, zero + 0.5f);
  p = fma(p, r, zero + 1.0f);
  p = fma(p, r, zero + 1.0f);
  return select(huge, zero + __builtin_inff(), select(tiny, zero, (RealF)((IntF)p + ((IntF)shifted << 23))));
}
BEAGS_INLINE RealD exponential(RealD x) {
  for (int i = 0; i < 4; ++i) x[i] = exp(x[i]);
  return x;
}

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
