// One lane: the same kernels without SIMD, the base of comparisons. See packs.h.
#pragma once

namespace beags {
namespace BEAGS_ISA {

template <class T>
struct Register {
  static constexpr int kLanes = 1, kParts = 1;
  using Vector = T;
  using Mask = bool;

  static BEAGS_INLINE T broadcast(T value) { return value; }
  static BEAGS_INLINE T load(const T* from) { return *from; }
  static BEAGS_INLINE T fma(T a, T b, T c) { return a * b + c; }
  static BEAGS_INLINE T min(T a, T b) { return a < b ? a : b; }
  static BEAGS_INLINE Mask less(T a, T b) { return a < b; }
  static BEAGS_INLINE Mask less_equal(T a, T b) { return a <= b; }
  static BEAGS_INLINE Mask equal(T a, T b) { return a == b; }
  static BEAGS_INLINE Mask both(Mask a, Mask b) { return a && b; }
  static BEAGS_INLINE Mask either(Mask a, Mask b) { return a || b; }
  static BEAGS_INLINE Mask without(Mask a, Mask b) { return a && !b; }
  static BEAGS_INLINE bool any(Mask mask) { return mask; }
  static BEAGS_INLINE T select(Mask mask, T yes, T no) { return mask ? yes : no; }
  static BEAGS_INLINE T keep(Mask mask, T value) { return mask ? value : T(0); }
  static BEAGS_INLINE T drop(Mask mask, T value) { return mask ? T(0) : value; }
  // Returns value 2^i; i lies in the lowest bits of `shifted`.
  static BEAGS_INLINE float scale(float value, float shifted) {
    uint32_t bits, i;
    __builtin_memcpy(&bits, &value, sizeof bits);
    __builtin_memcpy(&i, &shifted, sizeof i);
    bits += i << 23;
    __builtin_memcpy(&value, &bits, sizeof bits);
    return value;
  }
  static BEAGS_INLINE void sum4(const T* v, T* out) { __builtin_memcpy(out, v, 4 * sizeof(T)); }
};

}  // namespace BEAGS_ISA
}  // namespace beags
