// Answers queries of one tile, which have no gradient (sections 3 and 5). Included once for each instruction set.
#pragma once

#include "rasterizer/backward.h"
#include "rasterizer/composite.h"

namespace beags {
namespace BEAGS_ISA {

// Sums by label for one pair after the other, where a tile has few labels.
template <class T>
struct FewLabels {
  static constexpr int kMost = 4;
  alignas(64) T member[kMost][kTilePixels] = {};  // 1 at the pixels of a label
  Vector<T> sums[kMost] = {};
  int pair = -1;

  BEAGS_INLINE void add_hit(int k, int pack, Real<T> w, T* rows, int num_labels) {
    if (k != pair) flush(rows, num_labels);
    pair = k;
    for (int label = 0; label < kMost; ++label) add(sums[label], w, load(member[label] + pack * kLanes<T>));
  }
  void flush(T* rows, int num_labels) {
    T row[kMost];
    Register<T>::sum4(sums, row);
    for (int label = 0; label < kMost; ++label) sums[label] = Vector<T>{};
    for (int label = 0; label < num_labels && pair >= 0; ++label) {
      rows[static_cast<int64_t>(pair) * num_labels + label] = row[label];
    }
  }
};

// Sums w (E6), or [w > min_weight] with kCount, for each pair over the tile's pixels of each label; the labels are
// numbered within the tile.
template <bool kCount, class T>
void class_sums(const Job<T>& job, const Query<T>& query, int tile) {
  const int num_slots = query.num_slots[tile];
  if (num_slots == 0) return;
  T* sums = query.sums + query.slot_start[tile];
  const auto counted = [&](Real<T> w) __attribute__((always_inline)) {
    return kCount ? keep(all(query.min_weight) < w, all(T(1))) : w;
  };
  Walk<T> walk(job, tile);
  if (num_slots <= FewLabels<T>::kMost) {
    FewLabels<T> labels;
    for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
      if (query.slots[at] >= 0) labels.member[query.slots[at]][pack * kLanes<T> + lane] = T(1);
    });
    composite<0>(job, tile, walk, [&](int k, const Splat<T>&, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
      labels.add_hit(k, hits.pack[i], counted(w), sums, num_slots);
    });
    labels.flush(sums, num_slots);
    return;
  }
  int32_t slots[kTilePixels];
  for (int32_t& slot : slots) slot = -1;
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) { slots[pack * kLanes<T> + lane] = query.slots[at]; });
  composite<0>(job, tile, walk, [&](int k, const Splat<T>&, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    T* row = sums + static_cast<int64_t>(k) * num_slots;
    T lanes[kLanes<T>];
    store(lanes, counted(w));
    for (int lane = 0; lane < kLanes<T>; ++lane) {
      const int slot = slots[hits.pack[i] * kLanes<T> + lane];
      if (slot >= 0) row[slot] += lanes[lane];
    }
  });
}

// Sums by pair and label as class_sums, but only the `most` largest w of each pixel (the nearer of equals) among its
// first `within` hits. `query.found` has room for these.
template <class T>
void top_contributions(const Job<T>& job, const Query<T>& query, int tile) {
  const int num_slots = query.num_slots[tile];
  if (num_slots == 0) return;
  const int64_t pairs = job.tile_start[tile + 1] - job.tile_start[tile];
  const int64_t room = query.within < pairs ? query.within : pairs;
  int counts[kTilePixels] = {};
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk, [&](int k, const Splat<T>&, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    T lanes[kLanes<T>];
    store(lanes, w);
    for (int lane = 0; lane < kLanes<T>; ++lane) {
      const int pixel = hits.pack[i] * kLanes<T> + lane;
      if (lanes[lane] > T(0) && counts[pixel] < room) query.found[pixel * room + counts[pixel]++] = {lanes[lane], k};
    }
  });
  T* sums = query.sums + query.slot_start[tile];
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int pixel = pack * kLanes<T> + lane, slot = query.slots[at];
    if (slot < 0) return;
    Contribution<T>* found = query.found + pixel * room;
    for (int i = 0; i < counts[pixel] && i < query.most; ++i) {
      if (counts[pixel] > query.most) {  // This brings the largest of the rest to the front.
        int best = i;
        for (int other = i + 1; other < counts[pixel]; ++other) {
          const bool larger = found[other].w > found[best].w;
          if (larger || (found[other].w == found[best].w && found[other].pair < found[best].pair)) best = other;
        }
        const Contribution<T> largest = found[best];
        found[best] = found[i];
        found[i] = largest;
      }
      sums[static_cast<int64_t>(found[i].pair) * num_slots + slot] += found[i].w;
    }
  });
}

// Sums w by pixel and class. `query.sums` holds, for each class of the tile in rising order, 256 pixels; `query.slots`
// maps a class to its place, `query.labels` a place to its class.
template <class T>
void sum_by_class(const Job<T>& job, const Query<T>& query, int tile, Walk<T>& walk) {
  composite<0>(job, tile, walk, [&](int, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T>) {
    T* row = query.sums + static_cast<int64_t>(query.slots[s.class_id]) * kTilePixels + hits.pack[i] * kLanes<T>;
    store(row, load(row) + w);
  });
}

// Finds each pixel's class: that of the largest sum of w, the lowest of equals.
template <class T>
void class_map(const Job<T>& job, const Query<T>& query, int tile) {
  const int classes = query.num_slots[0];
  const T* sums = query.sums;
  Walk<T> walk(job, tile);
  sum_by_class(job, query, tile, walk);
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const int pixel = pack * kLanes<T> + lane;
    T best = 0;
    int32_t winner = 0;
    for (int c = 0; c < classes; ++c) {
      const T sum = sums[static_cast<int64_t>(c) * kTilePixels + pixel];
      if (sum > best) {
        best = sum;
        winner = query.labels[c];
      }
    }
    query.classes[at] = winner;
    query.share[at] = best > T(0) ? best / (T(1) - walk.transmittance[pixel]) : T(0);
  });
}

// Calls visit(the sum of a class at a pixel, its index in an image of the channels).
template <class T, class Visit>
BEAGS_INLINE void for_each_channel(const Job<T>& job, const Query<T>& query, int tile, Visit visit) {
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) __attribute__((always_inline)) {
    for (int c = 0; c < query.num_slots[0]; ++c) {
      visit(query.sums[static_cast<int64_t>(c) * kTilePixels + pack * kLanes<T> + lane],
            at * query.num_channels + query.labels[c]);
    }
  });
}

// Renders the sums of w by class as channels.
template <class T>
void class_channels(const Job<T>& job, const Query<T>& query, int tile) {
  Walk<T> walk(job, tile);
  sum_by_class(job, query, tile, walk);
  if (job.saved.end) walk.save(job.saved, tile);
  for_each_channel(job, query, tile, [&](T sum, int64_t at) { query.channels[at] = sum; });
}

// Computes their gradients: dL/dw is the gradient of the channel of the Gaussian's class, for any number of classes.
template <class T>
void class_channels_backward(const Job<T>& job, const Query<T>& query, int tile) {
  for_each_channel(job, query, tile, [&](T& gradient, int64_t at) { gradient = query.channel_gradients[at]; });
  Job<T> by_class = job;
  by_class.class_gradients = query.sums;
  by_class.class_places = query.slots;
  backward<kClassChannels>(by_class, tile);
}

// Finds each pixel's Gaussian with the largest w, the nearer of equals.
template <class T>
void dominant_gaussian(const Job<T>& job, const Query<T>& query, int tile) {
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
    query.classes[at] = k < 0 ? -1 : job.pairs[job.tile_start[tile] + k].splat;
  });
}

// Counts the work of the forward.
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
