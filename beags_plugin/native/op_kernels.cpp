#include "op_kernels.h"

#include <cstdlib>
#include <cstring>
#include <type_traits>

namespace beags {
namespace ops {
namespace {

// As for the rasterizer: BEAGS_ISA=baseline forces the plain kernels.
bool use_avx2() {
#if defined(__x86_64__)
  static const bool use = [] {
    const char* forced = std::getenv("BEAGS_ISA");
    if (forced && std::strcmp(forced, "baseline") == 0) return false;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  }();
  return use;
#else
  return false;
#endif
}

}  // namespace

template <class T>
const OpKernels<T>& op_kernels() {
#if defined(__x86_64__)
  if (use_avx2()) {
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
