#pragma once

#include <nanobind/nanobind.h>

namespace beags {
// Binds the CUDA ops; see beags_plugin/ops.
void bind_cuda_ops(nanobind::module_& m);
}  // namespace beags
