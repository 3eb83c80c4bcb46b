// Defines packs of pixels for the tile kernels, in the registers of the instruction set that the including file is
// compiled for (registers_*.h). A Real holds kParts<T> registers that run in step: that hides latencies and shares what
// is the same for all of them. Only the files of tile kernels include it, and everything lies in the namespace
// BEAGS_ISA; otherwise the linker would merge the copies.
#pragma once

#include <math.h>
#include <stdint.h>
#if defined(__AVX512F__)
#include <immintrin.h>
#endif

#include "simd/device.h"

#define BEAGS_UNROLL _Pragma("GCC unroll 4")

#if defined(BEAGS_SCALAR)
#include "rasterizer/registers_scalar.h"
#elif defined(__AVX512F__)
#include "rasterizer/registers_avx512.h"
#else
#include "rasterizer/registers_vectors.h"
#endif

namespace beags {
namespace BEAGS_ISA {

template <class T>
using Vector = typename Register<T>::Vector;
template <class T>
constexpr int kParts = Register<T>::kParts;
template <class T>
constexpr int kRegister = Register<T>::kLanes;
template <class T>
constexpr int kLanes = kRegister<T> * kParts<T>;

template <class T>
struct Real {
  Vector<T> part[kParts<T>];
};

template <class T>
struct Mask {
  typename Register<T>::Mask part[kParts<T>];
};

#define BEAGS_EACH(expression)                                               \
  BEAGS_UNROLL for (int i = 0; i < kParts<T>; ++i) out.part[i] = expression; \
  return out

template <class T>
BEAGS_INLINE Real<T> all(T value) {
  Real<T> out;
  BEAGS_EACH(Register<T>::broadcast(value));
}
template <class T>
BEAGS_INLINE Real<T> load(const T* from) {
  Real<T> out;
  BEAGS_EACH(Register<T>::load(from + i * kRegister<T>));
}
template <class T>
BEAGS_INLINE void store(T* to, Real<T> value) {
  BEAGS_UNROLL for (int i = 0; i < kParts<T>; ++i)
      __builtin_memcpy(to + i * kRegister<T>, &value.part[i], sizeof value.part[i]);
}
template <class T>
BEAGS_INLINE Mask<T> none() {
  return Mask<T>{};
}

#define BEAGS_OPERATOR(op)                                 \
  template <class T>                                       \
  BEAGS_INLINE Real<T> operator op(Real<T> a, Real<T> b) { \
    Real<T> out;                                           \
    BEAGS_EACH(a.part[i] op b.part[i]);                    \
  }
BEAGS_OPERATOR(+)
BEAGS_OPERATOR(-)
BEAGS_OPERATOR(*)
BEAGS_OPERATOR(/)
#undef BEAGS_OPERATOR

// Returns a b + c, with one rounding where the instruction set has it.
template <class T>
BEAGS_INLINE Real<T> fma(Real<T> a, Real<T> b, Real<T> c) {
  Real<T> out;
  BEAGS_EACH(Register<T>::fma(a.part[i], b.part[i], c.part[i]));
}
// Returns the smaller; b if either is NaN.
template <class T>
BEAGS_INLINE Real<T> min(Real<T> a, Real<T> b) {
  Real<T> out;
  BEAGS_EACH(Register<T>::min(a.part[i], b.part[i]));
}

#define BEAGS_MASK(name, Operand, operation)                  \
  template <class T>                                          \
  BEAGS_INLINE Mask<T> name(Operand<T> a, Operand<T> b) {     \
    Mask<T> out;                                              \
    BEAGS_EACH(Register<T>::operation(a.part[i], b.part[i])); \
  }
BEAGS_MASK(operator<=, Real, less_equal)
BEAGS_MASK(operator<, Real, less)
BEAGS_MASK(operator==, Real, equal)
BEAGS_MASK(operator&, Mask, both)
BEAGS_MASK(without, Mask, without)  // lanes of a that are not in b
#undef BEAGS_MASK

template <class T>
BEAGS_INLINE bool any(Mask<T> mask) {
  typename Register<T>::Mask joined = mask.part[0];
  BEAGS_UNROLL for (int i = 1; i < kParts<T>; ++i) joined = Register<T>::either(joined, mask.part[i]);
  return Register<T>::any(joined);
}
template <class T>
BEAGS_INLINE Real<T> select(Mask<T> mask, Real<T> yes, Real<T> no) {
  Real<T> out;
  BEAGS_EACH(Register<T>::select(mask.part[i], yes.part[i], no.part[i]));
}
// Returns `value` in the lanes of the mask, 0 elsewhere (where it may be infinite or NaN).
template <class T>
BEAGS_INLINE Real<T> keep(Mask<T> mask, Real<T> value) {
  Real<T> out;
  BEAGS_EACH(Register<T>::keep(mask.part[i], value.part[i]));
}
template <class T>
BEAGS_INLINE Real<T> drop(Mask<T> mask, Real<T> value) {  // keeps the lanes outside the mask
  Real<T> out;
  BEAGS_EACH(Register<T>::drop(mask.part[i], value.part[i]));
}

// Returns 2^x for -126 < x <= 0 (other lanes have no meaning); float32 to 2e-7: x = i + f with |f| <= 1/2, and a
// minimax polynomial for 2^f.
BEAGS_INLINE Real<float> exp2(Real<float> x) {
  using T = float;
  const Real<T> magic = all(12582912.0f);  // 1.5 * 2^23: the lowest bits of the sum hold x, rounded
  const Real<T> shifted = x + magic;
  const Real<T> f = x - (shifted - magic);
  Real<T> p = fma(all(1.3276470686e-3f), f, all(9.6755413240e-3f));
  p = fma(p, f, all(5.5507132775e-2f));
  p = fma(p, f, all(2.4022119724e-1f));
  p = fma(p, f, all(6.9314696706e-1f));
  p = fma(p, f, all(1.0000000717e+0f));
  Real<T> out;
  BEAGS_EACH(Register<T>::scale(p.part[i], shifted.part[i]));
}
BEAGS_INLINE Real<double> exp2(Real<double> x) {
  double lanes[kLanes<double>];
  store(lanes, x);
  for (double& lane : lanes) lane = ::exp2(lane);
  return load(lanes);
}
#undef BEAGS_EACH

// Adds to a sum over pixels, kept in one register.
template <class T>
BEAGS_INLINE void add(Vector<T>& sum, Real<T> value) {
  BEAGS_UNROLL for (int i = 0; i < kParts<T>; ++i) sum = sum + value.part[i];
}
template <class T>
BEAGS_INLINE void add(Vector<T>& sum, Real<T> a, Real<T> b) {  // adds a b
  BEAGS_UNROLL for (int i = 0; i < kParts<T>; ++i) sum = Register<T>::fma(a.part[i], b.part[i], sum);
}

}  // namespace BEAGS_ISA
}  // namespace beags
