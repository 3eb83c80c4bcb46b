// The losses that compare a drawn image with a picture or with itself (method, section 1).
#pragma once

#include "image_kernels.h"

namespace beags {
namespace ops {

struct PhotometricSums {
  double absolute, similar;  // sum of |x - y|, sum of the SSIM index
};

// Fills job.gradient if it is not null; makes job.slopes, job.sums and job.window itself.
template <class T>
PhotometricSums photometric(PhotometricJob<T> job, int threads);

// The sum of the errors; fills job.g_depth and job.g_normal if they are not null; makes job.shares and job.sums itself.
template <class T>
double normal_consistency(NormalJob<T> job, int threads);

}  // namespace ops
}  // namespace beags
