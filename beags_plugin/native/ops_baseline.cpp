// The ops' kernels for any processor.
#define BEAGS_ISA baseline
#include "cast_kernel.h"
#include "color_kernel.h"
#include "occupancy_kernel.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

extern const OpKernels<float> kOpKernelsF32 = {occupancy_block<float>, colors<float>, colors_backward<float>,
                                               cast_row<float>};
extern const OpKernels<double> kOpKernelsF64 = {occupancy_block<double>, colors<double>, colors_backward<double>,
                                                cast_row<double>};

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
