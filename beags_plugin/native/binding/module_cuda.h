#pragma once

#include <nanobind/nanobind.h>

namespace beags {
// Binds the CUDA rasterizer and the CUDA ops; see rasterizers/cuda.py.
void bind_cuda(nanobind::module_& m);
}  // namespace beags
