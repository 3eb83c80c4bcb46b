// How voxels are numbered, and the tiles of pixels. Private to the voxel votes.
#pragma once

#include <algorithm>
#include <cstdint>

#include "lifted_view.h"
#include "voxel_votes.h"

namespace beags {
namespace ops {

constexpr int kTile = 8;  // pixels are taken in tiles: neighbours mostly need the same bricks

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
