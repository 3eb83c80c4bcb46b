// Finds the Gaussians that reach each tile, nearest first.
#pragma once

#include <vector>

#include "rasterizer/projection.h"
#include "rasterizer/scratch.h"
#include "rasterizer/types.h"

namespace beags {

struct Bins {
  std::vector<int32_t> order;         // the Gaussians that reach a tile, by depth, then by index
  std::vector<int64_t> record_start;  // [N + 1]: the records of a Gaussian, in the order of their tiles
  std::vector<int64_t> tile_start;    // [tiles + 1] into pairs
  Scratch<Pair> pairs;                // ordered by tile, then by depth; kPrefetched unused ones follow
};

// A tile that a Gaussian reaches.
struct Reach {
  int32_t tile;
  uint16_t mask;  // see Pair
};

// Appends the tiles that the Gaussian reaches, in rising order; returns whether its box touches the image.
template <class T>
bool find_tiles(const View& view, const Splat<T>& splat, std::vector<Reach>& out);

constexpr int64_t kChunk = 256;  // Gaussians that a thread takes at a time

// Sorts the Gaussians into tiles. reached: for each kChunk Gaussians, the tiles of one after the other. record_start:
// [N + 1], the start of each Gaussian's tiles, counted over all chunks. depths: [N], set for Gaussians that reach a
// tile.
template <class T>
Bins bin(const View& view, const std::vector<std::vector<Reach>>& reached, std::vector<int64_t> record_start,
         const T* depths);

}  // namespace beags
