// Defines vectors of 16 or 32 bytes as GCC's and clang's vector extensions, which any instruction set can lower: the
// registers of the tile kernels (rasterizer/packs.h) and the lanes of the ops (ops/lanes.h). Files that include it are
// compiled for one instruction set each, so everything lies in the namespace BEAGS_ISA; otherwise the linker would
// merge the copies.
#pragma once

#include <math.h>
#include <stdint.h>
#if defined(__SSE2__)
#include <immintrin.h>
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#include "simd/device.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct IntegerOf;
template <>
struct IntegerOf<float> {
  using Signed = int32_t;
  using Unsigned = uint32_t;
};
template <>
struct IntegerOf<double> {
  using Signed = int64_t;
  using Unsigned = uint64_t;
};

// The types of vectors of kBytes bytes.
template <class T, int kBytes>
struct Vectors {
  static constexpr int kCount = kBytes / sizeof(T);
  using Whole = typename IntegerOf<T>::Signed;
  typedef T Real __attribute__((vector_size(kBytes)));
  typedef Whole Int __attribute__((vector_size(kBytes)));  // also a mask: 0 or -1
  typedef typename IntegerOf<T>::Unsigned Bits __attribute__((vector_size(kBytes)));
};

using Real4F = Vectors<float, 16>::Real;
using Real2D = Vectors<double, 16>::Real;
using Real8F = Vectors<float, 32>::Real;
using Real4D = Vectors<double, 32>::Real;

// Operations that the vector extensions lack, first for any instruction set, then with the instructions of some.
template <class R>
BEAGS_INLINE R fused(R a, R b, R c) {
  return a * b + c;
}
template <class R>
BEAGS_INLINE R root(R x) {
  for (unsigned i = 0; i < sizeof(R) / sizeof x[0]; ++i) x[i] = ::sqrt(x[i]);
  return x;
}
template <class R, class I>
BEAGS_INLINE R select(I mask, R yes, R no) {
  return (R)(((I)yes & mask) | ((I)no & ~mask));
}
template <class R>
BEAGS_INLINE R smaller(R a, R b) {  // b if either is NaN
  return select(a < b, a, b);
}
template <class I>
BEAGS_INLINE bool any_lane(I mask) {
  uint64_t words[sizeof(I) / 8], joined = 0;
  __builtin_memcpy(words, &mask, sizeof words);
  for (uint64_t word : words) joined |= word;
  return joined != 0;
}
// Returns, within each 16 bytes, the sums of neighbours of `a`, then those of `b`.
BEAGS_INLINE Real4F add_pairs(Real4F a, Real4F b) {
#if defined(__SSE2__)
  return _mm_add_ps(_mm_shuffle_ps(a, b, 0x88), _mm_shuffle_ps(a, b, 0xdd));
#elif defined(__aarch64__)
  return (Real4F)vpaddq_f32(a, b);
#else
  return Real4F{a[0] + a[1], a[2] + a[3], b[0] + b[1], b[2] + b[3]};
#endif
}

#if defined(__SSE2__)
BEAGS_INLINE Real4F smaller(Real4F a, Real4F b) { return _mm_min_ps(a, b); }
BEAGS_INLINE bool any_lane(Vectors<float, 16>::Int mask) { return _mm_movemask_epi8((__m128i)mask) != 0; }
BEAGS_INLINE bool any_lane(Vectors<double, 16>::Int mask) { return _mm_movemask_epi8((__m128i)mask) != 0; }
#elif defined(__aarch64__)
BEAGS_INLINE Real4F fused(Real4F a, Real4F b, Real4F c) { return (Real4F)vfmaq_f32(c, a, b); }
BEAGS_INLINE Real2D fused(Real2D a, Real2D b, Real2D c) { return (Real2D)vfmaq_f64(c, a, b); }
#endif
#if defined(__AVX2__) && defined(__FMA__)
BEAGS_INLINE Real8F fused(Real8F a, Real8F b, Real8F c) { return _mm256_fmadd_ps(a, b, c); }
BEAGS_INLINE Real4D fused(Real4D a, Real4D b, Real4D c) { return _mm256_fmadd_pd(a, b, c); }
BEAGS_INLINE Real8F root(Real8F x) { return _mm256_sqrt_ps(x); }
BEAGS_INLINE Real4D root(Real4D x) { return _mm256_sqrt_pd(x); }
BEAGS_INLINE Real8F smaller(Real8F a, Real8F b) { return _mm256_min_ps(a, b); }
BEAGS_INLINE Real4D smaller(Real4D a, Real4D b) { return _mm256_min_pd(a, b); }
BEAGS_INLINE Real8F select(Vectors<float, 32>::Int mask, Real8F yes, Real8F no) {
  return _mm256_blendv_ps(no, yes, (__m256)mask);
}
BEAGS_INLINE Real4D select(Vectors<double, 32>::Int mask, Real4D yes, Real4D no) {
  return _mm256_blendv_pd(no, yes, (__m256d)mask);
}
BEAGS_INLINE bool any_lane(Vectors<float, 32>::Int mask) { return _mm256_movemask_ps((__m256)mask) != 0; }
BEAGS_INLINE bool any_lane(Vectors<double, 32>::Int mask) { return _mm256_movemask_pd((__m256d)mask) != 0; }
BEAGS_INLINE Real8F add_pairs(Real8F a, Real8F b) {
  return _mm256_add_ps(_mm256_shuffle_ps(a, b, 0x88), _mm256_shuffle_ps(a, b, 0xdd));
}
#endif

}  // namespace BEAGS_ISA
}  // namespace beags
