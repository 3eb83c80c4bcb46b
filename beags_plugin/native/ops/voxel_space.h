// Numbers voxels and cuts images into tiles of pixels. Private to the voxel votes.
#pragma once

#include <algorithm>
#include <cstdint>

#include "ops/lifted_view.h"
#include "ops/voxel_votes.h"

namespace beags {
namespace ops {

constexpr int kTile = 8;  // side of a tile of pixels: neighbours mostly need the same bricks

inline uint64_t brick_key(int32_t x, int32_t y, int32_t z) {
  return static_cast<uint64_t>(x) << 38 | static_cast<uint64_t>(y) << 19 | static_cast<uint64_t>(z);
}
// Returns the place at which the search for a brick's slot begins. The eight bricks of a cube, needed together, have
// neighbouring places. The first bits number the share.
inline uint64_t place_of(uint64_t key) {
  constexpr uint64_t odd = uint64_t(1) << 38 | uint64_t(1) << 19 | 1;
  const uint64_t within = (key >> 36 & 4) | (key >> 18 & 2) | (key & 1);
  return (hash_of(key & ~odd) & ~uint64_t(7)) | within;
}
constexpr uint64_t kNextPlace = 9;  // An odd step reaches all slots.
// The cache of the bricks needed last. All bricks of a cube with a side of 16 bricks have distinct places.
constexpr int kKept = 1 << 12;
inline int kept_at(uint64_t key) { return static_cast<int>((key & 15) | (key >> 15 & 0xf0) | (key >> 30 & 0xf00)); }
// Returns a voxel's place in its brick.
inline int cell_of(int32_t x, int32_t y, int32_t z) { return (x & 3) << 4 | (y & 3) << 2 | (z & 3); }

// The voxels of a brick, a bit each, whose place along an axis (0: x) is 0; one step along it is a shift by `kShift`.
constexpr uint64_t kPlane[3] = {0xffff, 0x000f000f000f000f, 0x1111111111111111};
constexpr int kShift[3] = {16, 4, 1};

template <class T>
int tile_rows(const LiftedView<T>& view) {
  return (view.height + kTile - 1) / kTile;
}

// Calls do_tile(left, right, top, bottom) for the tiles of one row.
template <class T, class DoTile>
void each_tile(const LiftedView<T>& view, int row, DoTile do_tile) {
  const int top = row * kTile, bottom = std::min(top + kTile, view.height);
  for (int left = 0; left < view.width; left += kTile) do_tile(left, std::min(left + kTile, view.width), top, bottom);
}

// The results of `lift` for a tile's pixels, and the voxels of their points, at 8 (y - top) + x - left. Compilers
// vectorise plain loops over whole arrays. Pixels outside the image are not near.
template <class T>
struct LiftedTile {
  static constexpr int kPlaces = kTile * kTile;
  T point[3][kPlaces];
  int32_t voxel[3][kPlaces], near[kPlaces];

  LiftedTile(const LiftedView<T>& view, int left, int right, int top, int bottom) {
    T depth[kPlaces] = {}, px[kPlaces], py[kPlaces];
    for (int y = top; y < bottom; ++y) {
      const T* row = view.depth + static_cast<int64_t>(y) * view.width;
      std::copy(row + left, row + right, depth + (y - top) * kTile);
    }
    for (int i = 0; i < kPlaces; ++i) {
      px[i] = static_cast<T>(left + i % kTile) + T(0.5);
      py[i] = static_cast<T>(top + i / kTile) + T(0.5);
      near[i] = depth[i] > 0;
    }
    for (int a = 0; a < 3; ++a) {
      const T shift = view.b[a];
      for (int i = 0; i < kPlaces; ++i) {
        point[a][i] = depth[i] * ray_of(view, a, px[i], py[i]) + shift;
        near[i] &= in_reach(point[a][i]);
      }
    }
    for (int a = 0; a < 3; ++a) {
      for (int i = 0; i < kPlaces; ++i) voxel[a][i] = floor_of(near[i] ? point[a][i] : T(0));
    }
  }
};

}  // namespace ops
}  // namespace beags
