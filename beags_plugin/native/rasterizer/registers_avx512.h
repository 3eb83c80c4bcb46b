// Registers of AVX-512: 16 float32 lanes, one group of 4 x 4 pixels, or 8 float64 lanes. See packs.h.
#pragma once

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct Register;

template <>
struct Register<float> {
  static constexpr int kLanes = 16, kParts = 1;
  using Vector = __m512;
  using Mask = __mmask16;

  static BEAGS_INLINE Vector broadcast(float value) { return _mm512_set1_ps(value); }
  static BEAGS_INLINE Vector load(const float* from) { return _mm512_loadu_ps(from); }
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return _mm512_fmadd_ps(a, b, c); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return _mm512_min_ps(a, b); }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return _mm512_cmp_ps_mask(a, b, _CMP_EQ_OQ); }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return static_cast<Mask>(a & b); }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return static_cast<Mask>(a | b); }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return static_cast<Mask>(a & ~b); }
  static BEAGS_INLINE bool any(Mask mask) { return mask != 0; }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) { return _mm512_mask_blend_ps(mask, no, yes); }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return _mm512_maskz_mov_ps(mask, value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) {
    return _mm512_maskz_mov_ps(static_cast<Mask>(~mask), value);
  }
  // Returns value 2^i; i lies in the lowest bits of `shifted`.
  static BEAGS_INLINE Vector scale(Vector value, Vector shifted) {
    const __m512i i = _mm512_slli_epi32(_mm512_castps_si512(shifted), 23);
    return _mm512_castsi512_ps(_mm512_add_epi32(_mm512_castps_si512(value), i));
  }
  // Sets out[i] to the sum of the lanes of v[i], i = 0..3; always in the same order.
  static BEAGS_INLINE void sum4(const Vector* v, float* out) {
    const Vector low = add_pairs(v[0], v[1]), high = add_pairs(v[2], v[3]), sums = add_pairs(low, high);
    const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(sums), _mm512_extractf32x8_ps(sums, 1));
    _mm_storeu_ps(out, _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1)));
  }

 private:
  static BEAGS_INLINE Vector add_pairs(Vector a, Vector b) {
    return _mm512_add_ps(_mm512_shuffle_ps(a, b, 0x88), _mm512_shuffle_ps(a, b, 0xdd));
  }
};

template <>
struct Register<double> {
  static constexpr int kLanes = 8, kParts = 1;
  using Vector = __m512d;
  using Mask = __mmask8;

  static BEAGS_INLINE Vector broadcast(double value) { return _mm512_set1_pd(value); }
  static BEAGS_INLINE Vector load(const double* from) { return _mm512_loadu_pd(from); }
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return _mm512_fmadd_pd(a, b, c); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return _mm512_min_pd(a, b); }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ); }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return _mm512_cmp_pd_mask(a, b, _CMP_LE_OQ); }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return _mm512_cmp_pd_mask(a, b, _CMP_EQ_OQ); }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return static_cast<Mask>(a & b); }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return static_cast<Mask>(a | b); }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return static_cast<Mask>(a & ~b); }
  static BEAGS_INLINE bool any(Mask mask) { return mask != 0; }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) { return _mm512_mask_blend_pd(mask, no, yes); }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return _mm512_maskz_mov_pd(mask, value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) {
    return _mm512_maskz_mov_pd(static_cast<Mask>(~mask), value);
  }
  static BEAGS_INLINE void sum4(const Vector* v, double* out) {
    for (int i = 0; i < 4; ++i) {
      out[i] = ((v[i][0] + v[i][1]) + (v[i][2] + v[i][3])) + ((v[i][4] + v[i][5]) + (v[i][6] + v[i][7]));
    }
  }
};

}  // namespace BEAGS_ISA
}  // namespace beags
