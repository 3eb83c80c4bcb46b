// Evaluates one Gaussian at one pixel, and walks through a tile front to back (E2, E3). A thread is a pixel. A warp has
// two neighbouring groups of the tile, so that a bit of a pair's mask says whether half a warp takes part.
#pragma once

#include "cuda/rasterizer/frame.h"
#include "rasterizer/pixel_terms.h"

namespace beags {
namespace cuda {

using namespace beags::BEAGS_ISA;

constexpr int kBatch = 32;  // splats that a block holds at a time
constexpr int kTileWarps = kTilePixels / kWarpThreads;
static_assert(kTilePixels == kBlockThreads && kWarpThreads == 2 * kGroupPixels, "a thread is a pixel");

template <class T>
using Hit = GaussianHit<T, bool>;

// Returns zeros where the Gaussian does not contribute.
template <class T>
BEAGS_DEVICE Hit<T> evaluate(T near_plane, const Splat<T>& s, T dx, T dy, bool wanted) {
  Hit<T> hit = gaussian_hit(s, near_plane, dx, dy, wanted, s.plain);  // s.plain is the same for the whole warp.
  if (!hit.on) hit = Hit<T>{};
  return hit;
}

// Splats of consecutive pairs of a tile, in shared memory.
template <class T>
struct alignas(32) Batch {
  Splat<T> splats[kBatch];
  uint32_t masks[kBatch];
};

// Copies the splats of `count` pairs, from `first`. The caller sets the barriers around it.
template <class T>
BEAGS_DEVICE void load_batch(const Bins<T>& bins, int64_t first, int count, Batch<T>& batch) {
  constexpr int kWords = sizeof(Splat<T>) / sizeof(uint4);
  static_assert(sizeof(Splat<T>) % sizeof(uint4) == 0, "copied in words of 16 bytes");
  for (int i = threadIdx.x; i < count * kWords; i += kBlockThreads) {
    const int32_t gaussian = bins.pair_gaussian[bins.pairs[first + i / kWords]];
    reinterpret_cast<uint4*>(batch.splats)[i] = reinterpret_cast<const uint4*>(bins.splats + gaussian)[i % kWords];
  }
  for (int i = threadIdx.x; i < count; i += kBlockThreads) {
    batch.masks[i] = bins.keys[first + i] & ((1u << kMaskBits) - 1);
  }
}

// A thread's pixel.
template <class T>
struct Place {
  int tile, warp, lane, group;
  bool inside;  // the image
  int64_t at;   // index into it
  T x, y;       // its centre

  BEAGS_DEVICE explicit Place(const TileJob<T>& job) {
    const int thread = threadIdx.x;
    tile = blockIdx.x;
    warp = thread / kWarpThreads;
    lane = thread % kWarpThreads;
    group = thread / kGroupPixels;
    const int pixel = thread % kGroupPixels;
    const int column = tile % job.tiles_x * kTile + group % kGroup * kGroup + pixel % kGroup;
    const int row = tile / job.tiles_x * kTile + group / kGroup * kGroup + pixel / kGroup;
    inside = column < job.width && row < job.height;
    at = static_cast<int64_t>(row) * job.width + column;
    x = static_cast<T>(column) + T(0.5);
    y = static_cast<T>(row) + T(0.5);
  }
};

// The state of a pixel that is composited front to back.
template <class T>
struct Walk {
  T transmittance = T(1);
  int end;  // pairs before the one at which it stopped
};

// Composites a tile: calls visit(k, splat, hit, w, before) for whole warps, where a lane contributes; w is 0 in lanes
// without a contribution, `before` is T; k counts pairs within the tile.
template <class T, class Visit>
BEAGS_DEVICE void composite(const TileJob<T>& job, const Place<T>& place, Walk<T>& walk, Visit visit) {
  __shared__ Batch<T> batch;
  const int64_t start = job.bins.tile_start[place.tile];
  const int count = static_cast<int>(job.bins.tile_start[place.tile + 1] - start);
  bool live = place.inside;
  walk.end = live ? count : 0;
  for (int first = 0; first < count; first += kBatch) {
    if (__syncthreads_count(live) == 0) break;
    const int here = count - first < kBatch ? count - first : kBatch;
    load_batch(job.bins, start + first, here, batch);
    __syncthreads();
    if (!__any_sync(kWholeWarp, live)) continue;
    for (int j = 0; j < here; ++j) {
      const unsigned mask = batch.masks[j];
      if (!(mask >> (2 * place.warp) & 3)) continue;
      const Splat<T>& splat = batch.splats[j];
      const bool wanted = live && (mask >> place.group & 1);
      const Hit<T> hit = evaluate(job.near_plane, splat, place.x - splat.cx, place.y - splat.cy, wanted);
      const T before = walk.transmittance;
      T w = hit.alpha * before;
      const T after = before - w;
      if (after < T(kMinTransmittance)) {
        walk.end = first + j;
        live = false;
        w = 0;
      } else {
        walk.transmittance = after;
      }
      if (__any_sync(kWholeWarp, w > T(0))) visit(first + j, splat, hit, w, before);
    }
  }
}

}  // namespace cuda
}  // namespace beags
