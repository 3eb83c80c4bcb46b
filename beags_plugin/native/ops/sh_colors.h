// Computes colours from spherical harmonics, and their gradients (method, section 1).
#pragma once

#include "ops/kernels.h"

namespace beags {
namespace ops {

template <class T>
void sh_colors(const ColorJob<T>& job, int64_t count, int threads);
// Fills the gradients that are not null.
template <class T>
void sh_colors_backward(const ColorJob<T>& job, int64_t count, int threads);

}  // namespace ops
}  // namespace beags
