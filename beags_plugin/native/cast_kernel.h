// One row of labelled pixels cast into another view (method, section 2; E5). Included by the files that are compiled
// for one instruction set; -ffp-contract=off keeps each operation rounded as in masks/reprojection.py, so that both
// give the same votes.
#pragma once

#include "lanes.h"
#include "op_kernels.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
void cast_row(const CastJob<T>& job, int y, const T* depth, const int32_t* labels) {
  using R = typename Lanes<T>::Real;
  using I = typename Lanes<T>::Int;
  constexpr int kCount = Lanes<T>::kCount;
  const T* a = job.a;
  const T row = static_cast<T>(y) + T(0.5);
  const T cx = a[1] * row + a[2], cy = a[4] * row + a[5], cz = a[7] * row + a[8];
  const R zero = {}, width = zero + static_cast<T>(job.target_width), height = zero + static_cast<T>(job.target_height);
  R x = zero + T(0.5);
  for (int lane = 0; lane < kCount; ++lane) x[lane] += static_cast<T>(lane);
  for (int start = 0; start < job.source_width; start += kCount, x += static_cast<T>(kCount)) {
    const int count = job.source_width - start < kCount ? job.source_width - start : kCount;
    R d = {};
    __builtin_memcpy(&d, depth + start, count * sizeof(T));
    const R hx = d * (a[0] * x + cx) + job.b[0], hy = d * (a[3] * x + cy) + job.b[1];
    const R z = d * (a[6] * x + cz) + job.b[2];
    // Written as products so that z = 0, infinite and NaN points simply fail.
    const I lands = (z > zero) & (hx >= zero) & (hy >= zero) & (hx < width * z) & (hy < height * z) & (d > zero);
    I column = to_int(select(lands, hx / z, zero)), line = to_int(select(lands, hy / z, zero));
    column += column == job.target_width;  // the quotient may round up to the border itself
    line += line == job.target_height;
    typename Lanes<T>::Whole pixel[kCount];  // of the target, or -1
    T depth_there[kCount];
    const I at = (line * job.target_width + column) | ~lands;
    __builtin_memcpy(pixel, &at, sizeof pixel);
    __builtin_memcpy(depth_there, &z, sizeof depth_there);
    for (int lane = 0; lane < count; ++lane) {
      const int32_t label = labels[start + lane];
      if (pixel[lane] < 0 || static_cast<uint32_t>(label) >= static_cast<uint32_t>(job.num_classes)) continue;
      if (job.target_depth) {
        const T gap = depth_there[lane] - job.target_depth[pixel[lane]];
        if (!((gap < 0 ? -gap : gap) <= job.tau * depth_there[lane])) continue;
      }
      ++job.votes[static_cast<int64_t>(pixel[lane]) * job.num_classes + label];
    }
  }
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
