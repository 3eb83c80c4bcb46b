// Lists all kernels of the ops. Included once for each build, as rasterizer/tiles.h.
#pragma once

#include "ops/normal_consistency_kernel.h"
#include "ops/occupancy_loss_kernel.h"
#include "ops/photometric_kernel.h"
#include "ops/reprojection_votes_kernel.h"
#include "ops/sh_colors_kernel.h"
#include "ops/two_builds.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

#define BEAGS_TABLE(T)                                                                                               \
  template <>                                                                                                        \
  const OpKernels<T>& table() {                                                                                      \
    static constexpr OpKernels<T> all = {                                                                            \
        occupancy_block<T>,     colors<T>, colors_backward<T>, cast_row<T>, photometric<T>, photometric_gradient<T>, \
        photometric_scratch<T>, normal<T>, normal_gradient<T>};                                                      \
    return all;                                                                                                      \
  }
BEAGS_TABLE(float)
BEAGS_TABLE(double)
#undef BEAGS_TABLE

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
