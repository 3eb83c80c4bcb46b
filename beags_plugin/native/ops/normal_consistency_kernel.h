// Computes normal consistency and its gradient, one row at a time (method, section 1). Included once for each
// instruction set.
#pragma once

#include "ops/lanes.h"
#include "ops/normal_consistency_terms.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

// Returns the error of the pixels from `at` = (x, y) on. Writes the gradients of their rendered normals, and those of
// their four neighbours' depths into `shares`. x: one number in each lane.
template <class T, class Where>
BEAGS_INLINE RealOf<T> normal_error(const NormalJob<T>& job, int64_t at, RealOf<T> x, int y, Where lanes) {
  using R = RealOf<T>;
  const T* d = job.depth + at;
  const Depths<R> depths = {lanes.load(d), lanes.load(d + 1), lanes.load(d - 1), lanes.load(d + job.width),
                            lanes.load(d - job.width)};
  T numbers[3][Lanes<T>::kCount] = {};
  const int size = lanes.template size<T>();
  for (int lane = 0; lane < size; ++lane) {
    for (int c = 0; c < 3; ++c) numbers[c][lane] = job.normal[3 * (at + lane) + c];
  }
  const Triple<R> n = {Whole::load(numbers[0]), Whole::load(numbers[1]), Whole::load(numbers[2])};
  const NormalTerms<R> terms = normal_terms(job, x, y, depths, n, lanes.load(job.alpha + at));
  if (job.shares) {
    const int64_t map = static_cast<int64_t>(job.height) * job.width;
    for (int i = 0; i < 4; ++i) lanes.store(job.shares + i * map + at, terms.shares[i]);
    Whole::store(numbers[0], terms.g_normal.x);
    Whole::store(numbers[1], terms.g_normal.y);
    Whole::store(numbers[2], terms.g_normal.z);
    for (int lane = 0; lane < size; ++lane) {
      for (int c = 0; c < 3; ++c) job.g_normal[3 * (at + lane) + c] = numbers[c][lane];
    }
  }
  return terms.error;
}

// Writes zeros for a pixel on the image's border, which has no error.
template <class T>
BEAGS_INLINE void normal_border(const NormalJob<T>& job, int64_t at) {
  if (!job.shares) return;
  const int64_t map = static_cast<int64_t>(job.height) * job.width;
  for (int i = 0; i < 4; ++i) job.shares[i * map + at] = T(0);
  for (int c = 0; c < 3; ++c) job.g_normal[3 * at + c] = T(0);
}

// Sums the error of row `y`.
template <class T>
void normal(const NormalJob<T>& job, int y) {
  using R = RealOf<T>;
  const int64_t start = static_cast<int64_t>(y) * job.width;
  R sum = {};  // Determinism: summed lane by lane along the row, on any thread
  if (y == 0 || y + 1 >= job.height || job.width < 3) {
    for (int x = 0; x < job.width; ++x) normal_border(job, start + x);
  } else {
    normal_border(job, start);
    normal_border(job, start + job.width - 1);
    R x = {};
    for (int lane = 0; lane < Lanes<T>::kCount; ++lane) x[lane] = static_cast<T>(1 + lane);
    for_each_vector<T>(job.width - 2, [&](int64_t i, auto lanes) {
      sum += normal_error(job, start + 1 + i, x + static_cast<T>(i), y, lanes);
    });
  }
  double total = 0;
  for (int lane = 0; lane < Lanes<T>::kCount; ++lane) total += sum[lane];
  job.sums[y] = total;
}

// Computes row `y` of the gradient of the depth.
template <class T>
void normal_gradient(const NormalJob<T>& job, int y) {
  const int64_t start = static_cast<int64_t>(y) * job.width;
  for (int x = 0; x < job.width; ++x) job.g_depth[start + x] = gathered_shares(job, start + x);
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
