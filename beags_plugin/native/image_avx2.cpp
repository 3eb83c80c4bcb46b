// The image losses' kernels for processors with AVX2 and FMA; empty where the compiler was not told to use them.
#define BEAGS_ISA avx2
#if defined(__AVX2__) && defined(__FMA__)
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
#endif
