// Projects Gaussians to splats and sorts splats into tiles (E1, E2; the extent of E3).
#include <cstring>

#include "cuda/rasterizer/frame.h"
#include "cuda/rasterizer/primitives.h"
#include "rasterizer/extent.h"

namespace beags {
namespace cuda {
namespace {

constexpr uint32_t kLastKey = 0xFFFFFFFFu;  // key of Gaussians that reach no tile, and of unused pairs

// Calls visit(tile, mask) for each tile that a Gaussian reaches, in rising order; see find_tiles in
// rasterizer/binning.cpp.
template <class Visit>
BEAGS_DEVICE void for_each_tile(const Extent& extent, int tiles_x, Visit visit) {
  if (extent.first_row() > extent.last_row()) return;
  for (int tile_y = extent.first_row() / kTile; tile_y <= extent.last_row() / kTile; ++tile_y) {
    int first[kGroup], last[kGroup], low = tiles_x * kGroup, high = -1;
    for (int row = 0; row < kGroup; ++row) {
      extent.band(tile_y * kGroup + row, first[row], last[row]);
      if (first[row] > last[row]) continue;
      low = first[row] < low ? first[row] : low;
      high = last[row] > high ? last[row] : high;
    }
    for (int tile_x = low / kGroup; tile_x * kGroup <= high; ++tile_x) {
      unsigned mask = 0;
      for (int row = 0; row < kGroup; ++row) {
        const int from = first[row] - tile_x * kGroup, to = last[row] - tile_x * kGroup;
        const int low_bit = from > 0 ? from : 0, high_bit = to < kGroup - 1 ? to : kGroup - 1;
        if (low_bit <= high_bit) mask |= ((2u << high_bit) - (1u << low_bit)) << (kGroup * row);
      }
      if (mask) visit(tile_y * tiles_x + tile_x, mask);
    }
  }
}

// Depths are positive, so their bits have the same order.
BEAGS_DEVICE void depth_keys(float depth, uint32_t& high, uint32_t&) { memcpy(&high, &depth, sizeof high); }
BEAGS_DEVICE void depth_keys(double depth, uint32_t& high, uint32_t& low) {
  uint64_t bits;
  memcpy(&bits, &depth, sizeof bits);
  high = static_cast<uint32_t>(bits >> 32);
  low = static_cast<uint32_t>(bits);
}

template <class T>
__global__ void project_kernel(View view, Inputs<T> inputs, Bins<T> bins, bool* visible, uint32_t* high, uint32_t* low,
                               int32_t* indices) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= inputs.count) return;
  Splat<T> splat;
  const Fate fate = place_gaussian(view, inputs, i, splat);
  int32_t count = 0;
  bool seen = false;
  uint32_t high_key = kLastKey, low_key = kLastKey;
  if (fate == Fate::kRendered) {
    const Extent extent(view, splat);
    seen = extent.on_screen();
    if (seen) for_each_tile(extent, tiles_along(view.width), [&](int, unsigned) { ++count; });
    if (count) {
      depth_keys(splat.z, high_key, low_key);
      bins.splats[i] = splat;
    }
  }
  if (fate == Fate::kNonFinite) atomicAdd(reinterpret_cast<unsigned long long*>(bins.totals + 1), 1ull);
  bins.counts[i] = count;
  visible[i] = seen;
  high[i] = high_key;
  if (low) low[i] = low_key;
  indices[i] = static_cast<int32_t>(i);
}

// out[r] = keys[order[r]].
__global__ void gather_keys_kernel(int64_t count, const uint32_t* keys, const int32_t* order, uint32_t* out) {
  const int64_t r = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (r < count) out[r] = keys[order[r]];
}

__global__ void copy_kernel(int64_t count, const int32_t* from, int32_t* to) {
  const int64_t r = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (r < count) to[r] = from[r];
}

// Sets pair_start[r] to the number of pairs of order[r]; a prefix sum follows.
__global__ void gather_counts_kernel(int64_t count, const int32_t* counts, const int32_t* order, int64_t* pair_start) {
  const int64_t r = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (r <= count) pair_start[r] = r < count ? counts[order[r]] : 0;
}

__global__ void total_kernel(int64_t count, const int64_t* pair_start, int64_t* totals) {
  if (threadIdx.x == 0) totals[0] = pair_start[count];
}

template <class T>
__global__ void emit_kernel(View view, int64_t count, Bins<T> bins, uint32_t* keys, int32_t* pairs) {
  const int64_t r = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (r >= count) return;
  const int32_t gaussian = bins.order[r];
  if (bins.counts[gaussian] == 0) return;
  int64_t at = bins.pair_start[r];
  const Extent extent(view, bins.splats[gaussian]);
  for_each_tile(extent, tiles_along(view.width), [&](int tile, unsigned mask) {
    if (at < bins.capacity) {
      keys[at] = static_cast<uint32_t>(tile) << kMaskBits | mask;
      pairs[at] = static_cast<int32_t>(at);
      bins.pair_gaussian[at] = gaussian;
    }
    ++at;
  });
}

// tile_start is zero on entry.
__global__ void tile_start_kernel(int tiles, int64_t capacity, const int64_t* totals, const uint32_t* keys,
                                  int32_t* tile_start) {
  const int64_t k = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const int64_t total = totals[0] < capacity ? totals[0] : capacity;
  if (k >= total) return;
  const int tile = static_cast<int>(keys[k] >> kMaskBits);
  const int before = k ? static_cast<int>(keys[k - 1] >> kMaskBits) : -1;
  for (int t = before + 1; t <= tile; ++t) tile_start[t] = static_cast<int32_t>(k);
  if (k == total - 1) {
    for (int t = tile + 1; t <= tiles; ++t) tile_start[t] = static_cast<int32_t>(total);
  }
}

int bits_for(int values) {  // bits for the numbers below `values`, of which none is all ones
  int bits = 1;
  while ((1 << bits) - 1 < values) ++bits;
  return bits;
}

}  // namespace

template <class T>
void project_gaussians(const View& view, const Inputs<T>& inputs, const Bins<T>& bins, bool* visible,
                       const Scratch& scratch, Stream stream) {
  const int64_t n = inputs.count;
  constexpr bool kTwoKeys = sizeof(T) == 8;
  uint32_t *keys = scratch.keys[0], *sorted = scratch.keys[1], *low = kTwoKeys ? scratch.keys[2] : nullptr;
  fill_bytes(bins.totals, 0, 2 * sizeof(int64_t), stream);
  const auto project = project_kernel<T>;
  BEAGS_LAUNCH(project, blocks_for(n, 128), 128, stream, view, inputs, bins, visible, keys, low, scratch.values);
  if (n) {
    if (kTwoKeys) {  // Sort by the lower half, then by the upper half.
      sort_pairs(scratch.temporary, scratch.temporary_bytes, low, sorted, scratch.values, bins.order, n, 0, 32, stream);
      BEAGS_LAUNCH(gather_keys_kernel, blocks_for(n), kBlockThreads, stream, n, keys, bins.order, low);
      BEAGS_LAUNCH(copy_kernel, blocks_for(n), kBlockThreads, stream, n, bins.order, scratch.values);
      sort_pairs(scratch.temporary, scratch.temporary_bytes, low, sorted, scratch.values, bins.order, n, 0, 32, stream);
    } else {
      sort_pairs(scratch.temporary, scratch.temporary_bytes, keys, sorted, scratch.values, bins.order, n, 0, 32,
                 stream);
    }
  }
  BEAGS_LAUNCH(gather_counts_kernel, blocks_for(n + 1), kBlockThreads, stream, n, bins.counts, bins.order,
               bins.pair_start);
  exclusive_sum(scratch.temporary, scratch.temporary_bytes, bins.pair_start, n + 1, stream);
  BEAGS_LAUNCH(total_kernel, 1, kWarpThreads, stream, n, bins.pair_start, bins.totals);
}

template <class T>
void bin_gaussians(const View& view, int64_t count, const Bins<T>& bins, const Scratch& scratch, Stream stream) {
  const int tiles = tiles_along(view.width) * tiles_along(view.height);
  const size_t bytes = static_cast<size_t>(bins.capacity) * sizeof(uint32_t);
  fill_bytes(scratch.keys[0], 0xFF, bytes, stream);
  fill_bytes(scratch.values, 0, bytes, stream);
  fill_bytes(bins.tile_start, 0, (tiles + 1) * sizeof(int32_t), stream);
  const auto emit = emit_kernel<T>;
  BEAGS_LAUNCH(emit, blocks_for(count, 128), 128, stream, view, count, bins, scratch.keys[0], scratch.values);
  if (!bins.capacity) return;
  // Pairs are ordered by depth, and the sort is stable. Its bits reach to the top of the tile's number, where unused
  // pairs have ones.
  sort_pairs(scratch.temporary, scratch.temporary_bytes, scratch.keys[0], bins.keys, scratch.values, bins.pairs,
             bins.capacity, kMaskBits, kMaskBits + bits_for(tiles), stream);
  BEAGS_LAUNCH(tile_start_kernel, blocks_for(bins.capacity), kBlockThreads, stream, tiles, bins.capacity, bins.totals,
               bins.keys, bins.tile_start);
}

#define BEAGS_INSTANTIATE(T)                                                                                     \
  template void project_gaussians(const View&, const Inputs<T>&, const Bins<T>&, bool*, const Scratch&, Stream); \
  template void bin_gaussians(const View&, int64_t, const Bins<T>&, const Scratch&, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
