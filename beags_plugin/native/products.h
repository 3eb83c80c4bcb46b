// The products of one tile that need no gradient (sections 3 and 5). Included once for each instruction set.
#pragma once

#include "composite.h"

namespace beags {
namespace BEAGS_ISA {

// E6: for each pair, the sum of w over the tile's pixels of each label; the labels are numbered within the tile.
template <class T>
void class_contributions(const Job<T>& job, const Product<T>& product, int tile) {
  const int num_slots = product.num_slots[tile];
  if (num_slots == 0) return;
  int32_t slots[kTilePixels];
  for (int32_t& slot : slots) slot = -1;
  for_each_pixel(job, tile,
                 [&](int64_t at, int pack, int lane) { slots[pack * kLanes<T> + lane] = product.slots[at]; });
  T* sums = product.sums + product.slot_start[tile];
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk, [&](int k, const Splat<T>&, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    const int pack = hits.pack[i];
    T* row = sums + static_cast<int64_t>(k) * num_slots;
    T lanes[kLanes<T>];
    store(lanes, w);
    for (int lane = 0; lane < kLanes<T>; ++lane) {
      const int slot = slots[pack * kLanes<T> + lane];
      if (slot >= 0) row[slot] += lanes[lane];
    }
  });
}

// Each pixel's class: the largest sum of w; of equal ones the lowest. `product.sums` holds, for each class of the tile
// in rising order, 256 pixels; `product.slots` maps a class to its place, `product.labels` a place to its class.
template <class T>
void class_map(const Job<T>& job, const Product<T>& product, int tile) {
  const int classes = product.num_slots[0];
  T* sums = product.sums;
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk, [&](int, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    T* row = sums + static_cast<int64_t>(product.slots[s.class_id]) * kTilePixels + hits.pack[i] * kLanes<T>;
    store(row, load(row) + w);
  });
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int pixel = pack * kLanes<T> + lane;
    T best = 0;
    int32_t winner = 0;
    for (int c = 0; c < classes; ++c) {
      const T sum = sums[static_cast<int64_t>(c) * kTilePixels + pixel];
      if (sum > best) {
        best = sum;
        winner = product.labels[c];
      }
    }
    product.classes[at] = winner;
    product.share[at] = best > T(0) ? best / (T(1) - walk.transmittance[pixel]) : T(0);
  });
}

// The surfel with the largest w; of equal ones the nearer.
template <class T>
void heaviest(const Job<T>& job, const Product<T>& product, int tile) {
  T best[kTilePixels] = {}, pair[kTilePixels];
  for (T& at : pair) at = T(-1);
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk, [&](int k, const Splat<T>&, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    const int pack = hits.pack[i];
    T *to = best + pack * kLanes<T>, *which = pair + pack * kLanes<T>;
    const Mask<T> wins = load(to) < w;
    store(to, select(wins, w, load(to)));
    store(which, select(wins, all(static_cast<T>(k)), load(which)));
  });
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int64_t k = static_cast<int64_t>(pair[pack * kLanes<T> + lane]);
    product.classes[at] = k < 0 ? -1 : job.pairs[job.tile_start[tile] + k].splat;
  });
}

// What the forward does.
template <class T>
Work count(const Job<T>& job, int tile) {
  Work work{};
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk, [&](int, const Splat<T>&, const Hits<T>&, int, Real<T> w, Real<T>) {
    T lanes[kLanes<T>];
    store(lanes, w);
    for (const T lane : lanes) work.contributing += lane > T(0);
  });
  work.lanes = walk.evaluated * kLanes<T>;
  return work;
}

}  // namespace BEAGS_ISA
}  // namespace beags
