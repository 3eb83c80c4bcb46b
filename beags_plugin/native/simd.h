// Vectors of 32 bytes: 8 float32 or 4 float64 lanes. GCC and clang lower them to what the instruction set has.
// Included by the files of tile kernels only, each of which is compiled for one instruction set: so everything lies in
// the namespace BEAGS_ISA, lest the linker merge the copies.
#pragma once

#include <math.h>
#include <stdint.h>
#if defined(__AVX__)
#include <immintrin.h>
#endif

#define BEAGS_INLINE inline __attribute__((always_inline))

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct Simd;

template <>
struct Simd<float> {
  typedef float Real __attribute__((vector_size(32)));
  typedef int32_t Mask __attribute__((vector_size(32)));
  typedef int32_t Integer;
  static constexpr int kLanes = 8;
};

template <>
struct Simd<double> {
  typedef double Real __attribute__((vector_size(32)));
  typedef int64_t Mask __attribute__((vector_size(32)));
  typedef int64_t Integer;
  static constexpr int kLanes = 4;
};

template <class T>
using Real = typename Simd<T>::Real;
template <class T>
using Mask = typename Simd<T>::Mask;

// a b + c, in one rounding where the instruction set has it.
BEAGS_INLINE Real<float> fma(Real<float> a, Real<float> b, Real<float> c) {
#if defined(__FMA__)
  return _mm256_fmadd_ps(a, b, c);
#else
  return a * b + c;
#endif
}
BEAGS_INLINE Real<double> fma(Real<double> a, Real<double> b, Real<double> c) {
#if defined(__FMA__)
  return _mm256_fmadd_pd(a, b, c);
#else
  return a * b + c;
#endif
}

template <class M>
BEAGS_INLINE bool any(M mask) {
#if defined(__AVX__)
  return !_mm256_testz_si256((__m256i)mask, (__m256i)mask);
#else
  int64_t word[4];
  __builtin_memcpy(word, &mask, sizeof word);
  return (word[0] | word[1] | word[2] | word[3]) != 0;
#endif
}

// e^x for -87 < x <= 0, to 2e-7 (lanes outside hold garbage): e^x = 2^i 2^f with |f| <= 1/2, and a minimax polynomial
// for 2^f.
BEAGS_INLINE Real<float> exponential(Real<float> x) {
  const Real<float> y = x * 1.44269504088896341f;
  const Real<float> shifted = y + 12582912.0f;  // 1.5 * 2^23: the lowest bits now hold y, rounded
  const Real<float> f = y - (shifted - 12582912.0f);
  const Mask<float> i = (Mask<float>)shifted << 23;
  const Real<float> zero = {};
  Real<float> p = zero + 1.3276470686e-3f;
  p = fma(p, f, zero + 9.6755413240e-3f);
  p = fma(p, f, zero + 5.5507132775e-2f);
  p = fma(p, f, zero + 2.4022119724e-1f);
  p = fma(p, f, zero + 6.9314696706e-1f);
  p = fma(p, f, zero + 1.0000000717e+0f);
  return (Real<float>)((Mask<float>)p + i);
}
BEAGS_INLINE Real<double> exponential(Real<double> x) {
  for (int lane = 0; lane < Simd<double>::kLanes; ++lane) x[lane] = exp(x[lane]);
  return x;
}

// out[i] = sum of the lanes of vectors[i], i = 0..3; always in the same order.
BEAGS_INLINE void sum_lanes(const Real<float>* vectors, float* out) {
  typedef float Half __attribute__((vector_size(16)));
#define BEAGS_ADD_PAIRS(a, b) \
  (__builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14) + __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15))
  const Real<float> low = BEAGS_ADD_PAIRS(vectors[0], vectors[1]), high = BEAGS_ADD_PAIRS(vectors[2], vectors[3]);
  const Real<float> all = BEAGS_ADD_PAIRS(low, high);
#undef BEAGS_ADD_PAIRS
  const Half sum = __builtin_shufflevector(all, all, 0, 1, 2, 3) + __builtin_shufflevector(all, all, 4, 5, 6, 7);
  __builtin_memcpy(out, &sum, sizeof sum);
}
BEAGS_INLINE void sum_lanes(const Real<double>* vectors, double* out) {
  for (int i = 0; i < 4; ++i) out[i] = (vectors[i][0] + vectors[i][1]) + (vectors[i][2] + vectors[i][3]);
}

}  // namespace BEAGS_ISA
}  // namespace beags
