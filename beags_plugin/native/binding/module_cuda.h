#pragma once

#include <nanobind/nanobind.h>

namespace beags {
// Adds what the CUDA backend is made of; see rasterizers/cuda.py.
void bind_cuda(nanobind::module_& m);
}  // namespace beags
