// Computes L1 and SSIM of an image against a reference on the CPU (method, section 1).
#pragma once

#include "ops/kernels.h"

namespace beags {
namespace ops {

struct PhotometricSums {
  double absolute, similar;  // sum of |x - y|, sum of the SSIM index
};

// Sums L1 and SSIM. Fills job.gradient if it is not null; allocates job.slopes and job.sums itself.
template <class T>
PhotometricSums photometric(PhotometricJob<T> job, int threads);

}  // namespace ops
}  // namespace beags
