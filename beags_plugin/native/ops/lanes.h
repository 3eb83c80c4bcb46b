// Defines what the ops' kernels compute on vectors of 32 bytes (simd/vectors.h), 8 float32 or 4 float64 lanes on any
// instruction set, and walks a row of numbers, vector by vector.
#pragma once

#include "simd/vectors.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
using Lanes = beags::BEAGS_ISA::Vectors<T, 32>;
template <class T>
using RealOf = typename Lanes<T>::Real;

using RealF = RealOf<float>;
using IntF = Lanes<float>::Int;
using RealD = RealOf<double>;
using IntD = Lanes<double>::Int;

using beags::BEAGS_ISA::fused;
using beags::BEAGS_ISA::root;
using beags::BEAGS_ISA::select;

template <class T>
BEAGS_INLINE RealOf<T> load(const T* from) {
  RealOf<T> value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}
template <class T>
BEAGS_INLINE void store(T* to, RealOf<T> value) {
  __builtin_memcpy(to, &value, sizeof value);
}

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

// Returns e^x to 2 units in the last place; 0 below -87, infinity above 88. The exp2 of the rasterizer's
// packs.h is another polynomial, less accurate and faster.
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

// The lanes of a vector inside the row: all of them, or `count`; others hold zeros.
struct Whole {
  template <class T>
  BEAGS_INLINE static int size() {
    return Lanes<T>::kCount;
  }
  template <class T>
  BEAGS_INLINE static RealOf<T> load(const T* from) {
    return ops::BEAGS_ISA::load(from);
  }
  template <class T>
  BEAGS_INLINE static void store(T* to, RealOf<T> value) {
    ops::BEAGS_ISA::store(to, value);
  }
};
struct Part {
  int64_t count;
  template <class T>
  BEAGS_INLINE int size() const {
    return static_cast<int>(count);
  }
  template <class T>
  BEAGS_INLINE RealOf<T> load(const T* from) const {
    RealOf<T> value = {};
    for (int64_t i = 0; i < count; ++i) value[i] = from[i];
    return value;
  }
  template <class T>
  BEAGS_INLINE void store(T* to, RealOf<T> value) const {
    for (int64_t i = 0; i < count; ++i) to[i] = value[i];
  }
};

// Calls visit(first number, lanes) for every vector of a row of `line` numbers.
template <class T, class Visit>
BEAGS_INLINE void for_each_vector(int64_t line, Visit visit) {
  int64_t i = 0;
  for (; i + Lanes<T>::kCount <= line; i += Lanes<T>::kCount) visit(i, Whole{});
  if (i < line) visit(i, Part{line - i});
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
