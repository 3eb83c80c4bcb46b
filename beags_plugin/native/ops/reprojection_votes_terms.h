// Computes a pixel's vote in another view, and the winner of the votes for a pixel (method, section 2; E5), for the
// vectors of CPUs and the threads of GPUs. Each operation is rounded as in masks/reprojection.py (no fused operations),
// hence all give the same votes. Included once for each instruction set, or for GPUs.
#pragma once

#include "ops/kernels.h"
#include "simd/device.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

// The projection z (x', y', 1) of a pixel at depth d; its centre is x and the centre of its row. R: T, or a vector of
// T.
template <class R>
struct Projected {
  R hx, hy, z;
};

template <class T, class R>
BEAGS_HD_INLINE Projected<R> project_pixel(const CastJob<T>& job, R x, T y, R d) {
  const T* a = job.a;
  return {d * (a[0] * x + (a[1] * y + a[2])) + job.b[0], d * (a[3] * x + (a[4] * y + a[5])) + job.b[1],
          d * (a[6] * x + (a[7] * y + a[8])) + job.b[2]};
}

// Returns whether that is a pixel of the target. With products instead of quotients, z = 0, infinite and NaN points
// fail.
template <class T, class R>
BEAGS_HD_INLINE auto lands_in_target(const CastJob<T>& job, const Projected<R>& at, R d) {
  const R zero = {}, width = zero + static_cast<T>(job.target_width), height = zero + static_cast<T>(job.target_height);
  return (at.z > zero) & (at.hx >= zero) & (at.hy >= zero) & (at.hx < width * at.z) & (at.hy < height * at.z) &
         (d > zero);
}

// Returns whether a point at depth z is seen at that pixel of the target.
template <class T>
BEAGS_HD_INLINE bool seen_in_target(const CastJob<T>& job, int64_t pixel, T z) {
  if (!job.target_depth) return true;
  const T gap = z - job.target_depth[pixel];
  return (gap < 0 ? -gap : gap) <= job.tau * z;
}

// Sets the class with most votes and its share; a tie or no vote keeps the label. votes: [num_classes].
BEAGS_HD inline void decide_by_votes(const uint32_t* votes, int num_classes, int32_t* label, float* confidence) {
  uint32_t most = 0, total = 0;
  int winner = 0, leaders = 0;
  for (int c = 0; c < num_classes; ++c) {
    total += votes[c];
    if (votes[c] > most) {
      most = votes[c];
      winner = c;
      leaders = 1;
    } else if (votes[c] == most) {
      ++leaders;
    }
  }
  if (most > 0 && leaders == 1) *label = winner;
  *confidence = static_cast<float>(most) / static_cast<float>(total > 0 ? total : 1);
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
