// All kernels of the image losses. Included once for each build, as tiles.h.
#pragma once

#include "normal_kernel.h"
#include "photometric_kernel.h"
#include "two_builds.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

#define BEAGS_TABLE(T)                                                                                       \
  template <>                                                                                                \
  const ImageKernels<T>& table() {                                                                           \
    static constexpr ImageKernels<T> all = {photometric<T>, photometric_gradient<T>, photometric_scratch<T>, \
                                            normal<T>, normal_gradient<T>};                                  \
    return all;                                                                                              \
  }
BEAGS_TABLE(float)
BEAGS_TABLE(double)
#undef BEAGS_TABLE

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
