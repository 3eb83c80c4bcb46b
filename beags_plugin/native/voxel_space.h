// Pixels of a view as points among voxels, and how these are numbered. Private to the voxel votes.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "golden.h"
#include "voxel_votes.h"

namespace beags {
namespace ops {

constexpr int32_t kHalf = 1 << 20;  // voxels along each axis, to either side
constexpr int32_t kMargin = 8;      // what is read about a point is in reach too
constexpr int kTile = 8;            // pixels are taken in tiles: neighbours mostly need the same bricks

inline uint64_t hash_of(uint64_t key) {
  key = (key ^ key >> 32) * kGolden;
  return key ^ key >> 29;
}
inline uint64_t brick_key(int32_t x, int32_t y, int32_t z) {
  return static_cast<uint64_t>(x) << 38 | static_cast<uint64_t>(y) << 19 | static_cast<uint64_t>(z);
}
// Where a brick's slot is looked for: the eight bricks of a cube have places side by side, as they are needed together.
// The first bits tell shares apart.
inline uint64_t place_of(uint64_t key) {
  constexpr uint64_t odd = uint64_t(1) << 38 | uint64_t(1) << 19 | 1;
  const uint64_t within = (key >> 36 & 4) | (key >> 18 & 2) | (key & 1);
  return (hash_of(key & ~odd) & ~uint64_t(7)) | within;
}
constexpr uint64_t kNextPlace = 9;  // odd: all slots are reached
// Bricks that were needed last are kept at hand: those of a cube of 16 bricks' side have places of their own.
constexpr int kKept = 1 << 12;
inline int kept_at(uint64_t key) { return static_cast<int>((key & 15) | (key >> 15 & 0xf0) | (key >> 30 & 0xf00)); }
// A voxel's place in its brick.
inline int cell_of(int32_t x, int32_t y, int32_t z) { return (x & 3) << 4 | (y & 3) << 2 | (z & 3); }

// The voxels of a brick, a bit each, whose place along an axis (0: x) is 0; one step along it is a shift by `kShift`.
constexpr uint64_t kPlane[3] = {0xffff, 0x000f000f000f000f, 0x1111111111111111};
constexpr int kShift[3] = {16, 4, 1};

// Largest whole number that is not above x; |x| is small.
template <class T>
int32_t floor_of(T x) {
  const int32_t whole = static_cast<int32_t>(x);
  return whole - (static_cast<T>(whole) > x);
}

// A pixel's point and, for one unit of depth, the way along its ray, in voxels. False without a depth, or too far away.
template <class T>
bool lift(const LiftedView<T>& view, int x, int y, T* point, T* ray) {
  const T d = view.depth[static_cast<int64_t>(y) * view.width + x];
  if (!(d > 0)) return false;
  const T px = static_cast<T>(x) + T(0.5), py = static_cast<T>(y) + T(0.5);
  bool near = true;
  for (int r = 0; r < 3; ++r) {
    const T* a = view.a + 3 * r;
    ray[r] = a[0] * px + (a[1] * py + a[2]);
    point[r] = d * ray[r] + view.b[r];
    near = near && std::abs(point[r]) < static_cast<T>(kHalf - kMargin);  // false for NaN
  }
  return near;
}

template <class T>
int tile_rows(const LiftedView<T>& view) {
  return (view.height + kTile - 1) / kTile;
}

// do_tile(left, right, top, bottom) for the tiles of one row.
template <class T, class DoTile>
void each_tile(const LiftedView<T>& view, int row, DoTile do_tile) {
  const int top = row * kTile, bottom = std::min(top + kTile, view.height);
  for (int left = 0; left < view.width; left += kTile) do_tile(left, std::min(left + kTile, view.width), top, bottom);
}

}  // namespace ops
}  // namespace beags
