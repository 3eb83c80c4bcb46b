// The image losses' kernels for any processor.
#define BEAGS_ISA baseline
#include "normal_kernel.h"
#include "photometric_kernel.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

extern const ImageKernels<float> kImageKernelsF32 = {photometric<float>, photometric_gradient<float>,
                                                     photometric_scratch<float>, normal<float>, normal_gradient<float>};
extern const ImageKernels<double> kImageKernelsF64 = {photometric<double>, photometric_gradient<double>,
                                                      photometric_scratch<double>, normal<double>,
                                                      normal_gradient<double>};

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
