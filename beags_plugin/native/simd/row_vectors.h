// Walks a row of numbers, vector by vector. Included once for each instruction set.
#pragma once

#include "simd/lanes.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
using RealOf = typename Lanes<T>::Real;

// The lanes of a vector inside the row: all of them, or `count`; others hold zeros.
struct Whole {
  template <class T>
  BEAGS_INLINE static int size() {
    return Lanes<T>::kCount;
  }
  template <class T>
  BEAGS_INLINE static RealOf<T> load(const T* from) {
    RealOf<T> value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
  }
  template <class T>
  BEAGS_INLINE static void store(T* to, RealOf<T> value) {
    __builtin_memcpy(to, &value, sizeof value);
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
