#pragma once

#include <nanobind/nanobind.h>

namespace beags {
// Adds the ops of the CUDA backend; see beags_plugin/ops/cuda.py.
void bind_cuda_ops(nanobind::module_& m);
}  // namespace beags
