#include "op_kernels.h"

#include <type_traits>

#include "isa.h"

namespace beags {
namespace ops {

template <class T>
const OpKernels<T>& op_kernels() {
#if defined(BEAGS_HAS_AVX2)
  if (uses_avx2()) {
    if constexpr (std::is_same_v<T, float>) return avx2::kOpKernelsF32;
    if constexpr (std::is_same_v<T, double>) return avx2::kOpKernelsF64;
  }
#endif
  if constexpr (std::is_same_v<T, float>) return baseline::kOpKernelsF32;
  if constexpr (std::is_same_v<T, double>) return baseline::kOpKernelsF64;
}

template const OpKernels<float>& op_kernels();
template const OpKernels<double>& op_kernels();

}  // namespace ops
}  // namespace beags
