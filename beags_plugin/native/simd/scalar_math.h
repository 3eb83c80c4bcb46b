// `select`, `fma` and `sqrt` for what CPUs and GPUs share: of vectors on CPUs, of single numbers on GPUs.
#pragma once

#if !defined(__CUDACC__) && !defined(BEAGS_CUDA_EMULATION)
#include "simd/lanes.h"
#else

#include <math.h>  // fma and sqrt, of float too

#include "simd/device.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
BEAGS_HD_INLINE T select(bool mask, T yes, T no) {
  return mask ? yes : no;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags

#endif
