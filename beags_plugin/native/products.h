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
                 [&](int64_t at, int pack, int lane) { slots[pack * Simd<T>::kLanes + lane] = product.slots[at]; });
  T* sums = product.sums + product.slot_start[tile];
  Real<T> transmittance[kTilePacks<T>];
  composite(job, tile, transmittance,
            [&](int k, const Splat<T>&, int pack, const Hit<T>&, Mask<T>, Real<T> w, Real<T>, Real<T>) {
              T* row = sums + static_cast<int64_t>(k) * num_slots;
              for (int lane = 0; lane < Simd<T>::kLanes; ++lane) {
                const int slot = slots[pack * Simd<T>::kLanes + lane];
                if (slot >= 0) row[slot] += w[lane];
              }
            });
}

// Each pixel's class: the largest sum of w; of equal ones the lowest. `product.sums` holds, for each class of the tile
// in rising order, 256 pixels; `product.slots` maps a class to its place, `product.labels` a place to its class.
template <class T>
void class_map(const Job<T>& job, const Product<T>& product, int tile) {
  Real<T> transmittance[kTilePacks<T>];
  const int classes = product.num_slots[0];
  T* sums = product.sums;
  composite(job, tile, transmittance,
            [&](int, const Splat<T>& s, int pack, const Hit<T>&, Mask<T>, Real<T> w, Real<T>, Real<T>) {
              T* row = sums + static_cast<int64_t>(product.slots[s.class_id]) * kTilePixels + pack * Simd<T>::kLanes;
              store(row, load(row) + w);
            });
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int pixel = pack * Simd<T>::kLanes + lane;
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
    product.share[at] = best > T(0) ? best / (T(1) - transmittance[pack][lane]) : T(0);
  });
}

// The surfel with the largest w; of equal ones the nearer.
template <class T>
void heaviest(const Job<T>& job, const Product<T>& product, int tile) {
  Real<T> transmittance[kTilePacks<T>], best[kTilePacks<T>];
  Mask<T> pair[kTilePacks<T>];
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    best[pack] = Real<T>{};
    pair[pack] = ~Mask<T>{};
  }
  composite(job, tile, transmittance,
            [&](int k, const Splat<T>&, int pack, const Hit<T>&, Mask<T>, Real<T> w, Real<T>, Real<T>) {
              const Mask<T> wins = w > best[pack];
              best[pack] = wins ? w : best[pack];
              pair[pack] = wins ? Mask<T>{} + k : pair[pack];
            });
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int64_t k = pair[pack][lane];
    product.classes[at] = k < 0 ? -1 : job.pairs[job.tile_start[tile] + k].splat;
  });
}

}  // namespace BEAGS_ISA
}  // namespace beags
