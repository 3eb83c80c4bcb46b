// Computes normal consistency of a rendered view on the CPU (method, section 1).
#pragma once

#include "ops/kernels.h"

namespace beags {
namespace ops {

// Returns the sum of the errors. Fills job.g_depth and job.g_normal if they are not null; allocates job.shares and
// job.sums itself.
template <class T>
double normal_consistency(NormalJob<T> job, int threads);

}  // namespace ops
}  // namespace beags
