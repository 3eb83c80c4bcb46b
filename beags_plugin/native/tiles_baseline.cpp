// The tile kernels for any processor.
#define BEAGS_ISA baseline
#include "tiles.h"

namespace beags {
namespace BEAGS_ISA {

extern const Kernels<float> kKernelsF32 = kernels<float>();
extern const Kernels<double> kKernelsF64 = kernels<double>();

}  // namespace BEAGS_ISA
}  // namespace beags
