// Registers of AVX2 with FMA: 8 float32 or 4 float64 lanes. See simd.h.
#pragma once

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct Register;

template <>
struct Register<float> {
  static constexpr int kLanes = 8, kParts = 2;
  using Vector = __m256;
  using Mask = __m256;  // all bits of a lane, or none

  static BEAGS_INLINE Vector broadcast(float value) { return _mm256_set1_ps(value); }
  static BEAGS_INLINE Vector load(const float* from) { return _mm256_loadu_ps(from); }
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return _mm256_fmadd_ps(a, b, c); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return _mm256_min_ps(a, b); }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return _mm256_cmp_ps(a, b, _CMP_LE_OQ); }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return _mm256_cmp_ps(a, b, _CMP_EQ_OQ); }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return _mm256_and_ps(a, b); }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return _mm256_or_ps(a, b); }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return _mm256_andnot_ps(b, a); }
  static BEAGS_INLINE bool any(Mask mask) { return _mm256_movemask_ps(mask) != 0; }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) { return _mm256_blendv_ps(no, yes, mask); }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return _mm256_and_ps(mask, value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) { return _mm256_andnot_ps(mask, value); }
  // Returns value 2^i; i lies in the lowest bits of `shifted`.
  static BEAGS_INLINE Vector scale(Vector value, Vector shifted) {
    const __m256i i = _mm256_slli_epi32(_mm256_castps_si256(shifted), 23);
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(value), i));
  }
  // Sets out[i] to the sum of the lanes of v[i], i = 0..3; always in the same order.
  static BEAGS_INLINE void sum4(const Vector* v, float* out) {
    const Vector low = add_pairs(v[0], v[1]), high = add_pairs(v[2], v[3]), sums = add_pairs(low, high);
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(sums), _mm256_extractf128_ps(sums, 1)));
  }

 private:
  static BEAGS_INLINE Vector add_pairs(Vector a, Vector b) {
    return _mm256_add_ps(_mm256_shuffle_ps(a, b, 0x88), _mm256_shuffle_ps(a, b, 0xdd));
  }
};

template <>
struct Register<double> {
  static constexpr int kLanes = 4, kParts = 1;
  using Vector = __m256d;
  using Mask = __m256d;

  static BEAGS_INLINE Vector broadcast(double value) { return _mm256_set1_pd(value); }
  static BEAGS_INLINE Vector load(const double* from) { return _mm256_loadu_pd(from); }
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return _mm256_fmadd_pd(a, b, c); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return _mm256_min_pd(a, b); }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return _mm256_cmp_pd(a, b, _CMP_LT_OQ); }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return _mm256_cmp_pd(a, b, _CMP_LE_OQ); }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return _mm256_cmp_pd(a, b, _CMP_EQ_OQ); }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return _mm256_and_pd(a, b); }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return _mm256_or_pd(a, b); }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return _mm256_andnot_pd(b, a); }
  static BEAGS_INLINE bool any(Mask mask) { return _mm256_movemask_pd(mask) != 0; }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) { return _mm256_blendv_pd(no, yes, mask); }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return _mm256_and_pd(mask, value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) { return _mm256_andnot_pd(mask, value); }
  static BEAGS_INLINE void sum4(const Vector* v, double* out) {
    for (int i = 0; i < 4; ++i) out[i] = (v[i][0] + v[i][1]) + (v[i][2] + v[i][3]);
  }
};

}  // namespace BEAGS_ISA
}  // namespace beags
