// One row of labelled pixels cast into another view (method, section 2; E5). Included by the files that are compiled
// for one instruction set; -ffp-contract=off keeps each operation rounded as in masks/reprojection.py, so that both
// give the same votes.
#pragma once

#include <math.h>

#include "op_kernels.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

constexpr int kStrip = 64;  // pixels projected at a time

template <class T>
void cast_row(const CastJob<T>& job, int y, const T* depth, const int32_t* labels) {
  const T* a = job.a;
  const T row = static_cast<T>(y) + T(0.5);
  const T cx = a[1] * row + a[2], cy = a[4] * row + a[5], cz = a[7] * row + a[8];
  const T width = static_cast<T>(job.target_width), height = static_cast<T>(job.target_height);
  for (int start = 0; start < job.source_width; start += kStrip) {
    const int count = job.source_width - start < kStrip ? job.source_width - start : kStrip;
    T z[kStrip];
    int32_t pixel[kStrip];  // of the target, or -1
    for (int i = 0; i < count; ++i) {
      const T x = static_cast<T>(start + i) + T(0.5), d = depth[start + i];
      const T hx = d * (a[0] * x + cx) + job.b[0], hy = d * (a[3] * x + cy) + job.b[1];
      z[i] = d * (a[6] * x + cz) + job.b[2];
      // Written as products so that z = 0, infinite and NaN points simply fail.
      const bool lands = (z[i] > 0) & (hx >= 0) & (hy >= 0) & (hx < width * z[i]) & (hy < height * z[i]) & (d > 0);
      const int32_t px = static_cast<int32_t>(lands ? hx / z[i] : T(0));
      const int32_t py = static_cast<int32_t>(lands ? hy / z[i] : T(0));
      // The quotient may round up to the border itself.
      const int32_t column = px < job.target_width ? px : job.target_width - 1;
      const int32_t line = py < job.target_height ? py : job.target_height - 1;
      pixel[i] = lands ? line * job.target_width + column : -1;
    }
    for (int i = 0; i < count; ++i) {
      const int32_t label = labels[start + i];
      if (pixel[i] < 0 || static_cast<uint32_t>(label) >= static_cast<uint32_t>(job.num_classes)) continue;
      if (job.target_depth && !(fabs(z[i] - job.target_depth[pixel[i]]) <= job.tau * z[i])) continue;
      ++job.votes[static_cast<int64_t>(pixel[i]) * job.num_classes + label];
    }
  }
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
