// Lifts pixels of a view to points among voxels, on CPUs and GPUs. Each operation is rounded as in
// masks/pooled_votes.py, so that all get the same points.
#pragma once

#include <math.h>
#include <stdint.h>

#include "ops/hash.h"
#include "simd/device.h"

namespace beags {
namespace ops {

// A pixel (x, y) at depth d lies at d a (x, y, 1) + b, in voxels. depth: [height, width]. voxel: its side, as a depth.
template <class T>
struct LiftedView {
  int height, width;
  const T* depth;
  T a[9], b[3], voxel;
};

constexpr int32_t kHalf = 1 << 20;  // voxels along each axis, to either side
constexpr int32_t kMargin = 8;      // margin for the voxels that are read around a point
constexpr int32_t kParts = 64;      // steps per voxel of interpolation weights
constexpr int kLook = 2;            // steps before and behind a point along its ray, where votes disagree

BEAGS_HD inline uint64_t hash_of(uint64_t key) {
  key = (key ^ key >> 32) * kGolden;
  return key ^ key >> 29;
}

// Returns the largest whole number that is not above x; |x| is small.
template <class T>
BEAGS_HD inline int32_t floor_of(T x) {
  const int32_t whole = static_cast<int32_t>(x);
  return whole - (static_cast<T>(whole) > x);
}

// Returns the step along one axis, in voxels, of the ray through (px, py), in pixels, for one unit of depth.
template <class T>
BEAGS_HD inline T ray_of(const LiftedView<T>& view, int axis, T px, T py) {
  const T* a = view.a + 3 * axis;
  return a[0] * px + (a[1] * py + a[2]);
}

template <class T>
BEAGS_HD inline bool in_reach(T coordinate) {
  return fabs(coordinate) < static_cast<T>(kHalf - kMargin);  // The comparison is false for NaN.
}

// Computes a pixel's point and the step along its ray, on GPUs; the CPU has `LiftedTile`. Returns false without a
// depth, or too far away.
template <class T>
BEAGS_HD inline bool lift(const LiftedView<T>& view, int x, int y, T* point, T* ray) {
  const T d = view.depth[static_cast<int64_t>(y) * view.width + x];
  const T px = static_cast<T>(x) + T(0.5), py = static_cast<T>(y) + T(0.5);
  bool near = d > 0;
  for (int r = 0; r < 3; ++r) {
    ray[r] = ray_of(view, r, px, py);
    point[r] = d * ray[r] + view.b[r];
    near = near && in_reach(point[r]);
  }
  return near;
}

// The eight voxels around a point, from `corner`. fraction: position between the centres of the first and the second,
// in units of 1 / kParts.
struct NearVoxels {
  int32_t corner[3], fraction[3];
};

template <class T>
BEAGS_HD inline NearVoxels about(const T* point) {
  NearVoxels place;
  for (int a = 0; a < 3; ++a) {
    const T at = point[a] - T(0.5);
    const int32_t whole = floor_of(at);
    place.corner[a] = whole + kHalf;
    place.fraction[a] = static_cast<int32_t>((at - static_cast<T>(whole)) * T(kParts));
  }
  return place;
}

}  // namespace ops
}  // namespace beags
