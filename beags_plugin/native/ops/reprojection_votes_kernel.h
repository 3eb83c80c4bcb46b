// Projects one row of labelled pixels into another view (method, section 2; E5). Included once for each instruction
// set, with -ffp-contract=off.
#pragma once

#include "ops/lanes.h"
#include "ops/reprojection_votes_terms.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
void cast_row(const CastJob<T>& job, int y, const T* depth, const int32_t* labels) {
  using R = RealOf<T>;
  using I = typename Lanes<T>::Int;
  constexpr int kCount = Lanes<T>::kCount;
  const T row = static_cast<T>(y) + T(0.5);
  const R zero = {};
  R x = zero + T(0.5);
  for (int lane = 0; lane < kCount; ++lane) x[lane] += static_cast<T>(lane);
  for (int start = 0; start < job.source_width; start += kCount, x += static_cast<T>(kCount)) {
    const int count = job.source_width - start < kCount ? job.source_width - start : kCount;
    R d = {};
    __builtin_memcpy(&d, depth + start, count * sizeof(T));
    const Projected<R> to = project_pixel<T, R>(job, x, row, d);
    const I lands = lands_in_target<T, R>(job, to, d);
    I column = to_int(select(lands, to.hx / to.z, zero)), line = to_int(select(lands, to.hy / to.z, zero));
    column += column == job.target_width;  // The quotient may round up to the border itself.
    line += line == job.target_height;
    typename Lanes<T>::Whole pixel[kCount];  // pixel of the target, or -1
    T depth_there[kCount];
    const I at = (line * job.target_width + column) | ~lands;
    __builtin_memcpy(pixel, &at, sizeof pixel);
    __builtin_memcpy(depth_there, &to.z, sizeof depth_there);
    for (int lane = 0; lane < count; ++lane) {
      const int32_t label = labels[start + lane];
      if (pixel[lane] < 0 || static_cast<uint32_t>(label) >= static_cast<uint32_t>(job.num_classes)) continue;
      if (!seen_in_target(job, pixel[lane], depth_there[lane])) continue;
      ++job.votes[static_cast<int64_t>(pixel[lane]) * job.num_classes + label];
    }
  }
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
