// Registers of 16 bytes as GCC's and clang's vector extensions: SSE2, NEON or whatever the processor has. See simd.h.
#pragma once

namespace beags {
namespace BEAGS_ISA {

template <class T, class Integer>
struct GenericRegister {
  static constexpr int kLanes = 16 / sizeof(T), kParts = 2;
  typedef T Vector __attribute__((vector_size(16)));
  typedef Integer Mask __attribute__((vector_size(16)));  // -1 or 0

  static BEAGS_INLINE Vector broadcast(T value) { return value - Vector{}; }  // x - 0 is x, bit by bit
  static BEAGS_INLINE Vector load(const T* from) {
    Vector value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
  }
  static BEAGS_INLINE Mask less(Vector a, Vector b) { return a < b; }
  static BEAGS_INLINE Mask less_equal(Vector a, Vector b) { return a <= b; }
  static BEAGS_INLINE Mask equal(Vector a, Vector b) { return a == b; }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return a & b; }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return a | b; }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return a & ~b; }
  static BEAGS_INLINE Vector keep(Mask mask, Vector value) { return (Vector)(mask & (Mask)value); }
  static BEAGS_INLINE Vector drop(Mask mask, Vector value) { return (Vector)(~mask & (Mask)value); }
  static BEAGS_INLINE Vector select(Mask mask, Vector yes, Vector no) {
    return (Vector)((mask & (Mask)yes) | (~mask & (Mask)no));
  }
#if defined(__SSE2__)
  static BEAGS_INLINE bool any(Mask mask) { return _mm_movemask_epi8((__m128i)mask) != 0; }
#else
  static BEAGS_INLINE bool any(Mask mask) {
    uint64_t word[2];
    __builtin_memcpy(word, &mask, sizeof word);
    return (word[0] | word[1]) != 0;
  }
#endif
};

template <class T>
struct Register;

template <>
struct Register<float> : GenericRegister<float, int32_t> {
#if defined(__SSE2__)
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return a * b + c; }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return _mm_min_ps(a, b); }
  static BEAGS_INLINE Vector add_pairs(Vector a, Vector b) {
    return _mm_shuffle_ps(a, b, 0x88) + _mm_shuffle_ps(a, b, 0xdd);
  }
#elif defined(__aarch64__)
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return (Vector)vfmaq_f32(c, a, b); }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return select(a < b, a, b); }
  static BEAGS_INLINE Vector add_pairs(Vector a, Vector b) { return (Vector)vpaddq_f32(a, b); }
#else
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return a * b + c; }
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return select(a < b, a, b); }
  static BEAGS_INLINE Vector add_pairs(Vector a, Vector b) {
    return Vector{a[0] + a[1], a[2] + a[3], b[0] + b[1], b[2] + b[3]};
  }
#endif
  // Returns value 2^i; i lies in the lowest bits of `shifted`.
  static BEAGS_INLINE Vector scale(Vector value, Vector shifted) {
    return (Vector)((Mask)value + ((Mask)shifted << 23));
  }
  // Sets out[i] to the sum of the lanes of v[i], i = 0..3; always in the same order.
  static BEAGS_INLINE void sum4(const Vector* v, float* out) {
    const Vector sums = add_pairs(add_pairs(v[0], v[1]), add_pairs(v[2], v[3]));
    __builtin_memcpy(out, &sums, sizeof sums);
  }
};

template <>
struct Register<double> : GenericRegister<double, int64_t> {
#if defined(__aarch64__)
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return (Vector)vfmaq_f64(c, a, b); }
#else
  static BEAGS_INLINE Vector fma(Vector a, Vector b, Vector c) { return a * b + c; }
#endif
  static BEAGS_INLINE Vector min(Vector a, Vector b) { return select(a < b, a, b); }
  static BEAGS_INLINE void sum4(const Vector* v, double* out) {
    for (int i = 0; i < 4; ++i) out[i] = v[i][0] + v[i][1];
  }
};

}  // namespace BEAGS_ISA
}  // namespace beags
