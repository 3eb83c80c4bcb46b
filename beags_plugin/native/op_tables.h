// All kernels of the ops. Included once for each build, as tiles.h.
#pragma once

#include "cast_kernel.h"
#include "color_kernel.h"
#include "occupancy_kernel.h"
#include "two_builds.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

#define BEAGS_TABLE(T)                                                                                    \
  template <>                                                                                             \
  const OpKernels<T>& table() {                                                                           \
    static constexpr OpKernels<T> all = {occupancy_block<T>, colors<T>, colors_backward<T>, cast_row<T>}; \
    return all;                                                                                           \
  }
BEAGS_TABLE(float)
BEAGS_TABLE(double)
#undef BEAGS_TABLE

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
