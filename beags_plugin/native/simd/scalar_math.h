// Defines, for GPUs and on single numbers, the operations that the rasterizer's packs.h and the ops' lanes.h define on
// vectors: code that the CPU and GPUs share calls them by these names.
#pragma once

#include <math.h>  // fma, sqrt and exp2, also for float

#include "simd/device.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
BEAGS_HD_INLINE T all(T value) {
  return value;
}
template <class T>
BEAGS_HD_INLINE T min(T a, T b) {
  return a < b ? a : b;
}
template <class T>
BEAGS_HD_INLINE T select(bool mask, T yes, T no) {
  return mask ? yes : no;
}
template <class T>
BEAGS_HD_INLINE T keep(bool mask, T value) {
  return mask ? value : T(0);
}

}  // namespace BEAGS_ISA

namespace ops {
namespace BEAGS_ISA {
using beags::BEAGS_ISA::select;
}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
