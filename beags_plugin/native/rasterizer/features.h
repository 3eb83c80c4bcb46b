// Renders channels of features and sums their gradients over a tile. Included once for each instruction set.
#pragma once

#include "rasterizer/composite.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
BEAGS_INLINE const T* features_of(const Job<T>& job, const Splat<T>& s) {
  return job.features + (&s - job.splats) * job.num_features;
}

// Returns a pack's channels in the tile's working memory, one after the other.
template <class T>
BEAGS_INLINE T* work_of(const Job<T>& job, int pack) {
  return job.feature_work + static_cast<int64_t>(pack) * kLanes<T> * job.num_features;
}

// Returns the sums of a pair's channels, one register each, which lie behind those of the pixels.
template <class T>
BEAGS_INLINE Vector<T>* pair_sums(const Job<T>& job) {
  return reinterpret_cast<Vector<T>*>(job.feature_work + static_cast<int64_t>(kTilePixels) * job.num_features);
}

template <class T>
BEAGS_INLINE void clear_feature_work(const Job<T>& job) {
  for (int i = 0; i < kTilePixels * job.num_features; ++i) job.feature_work[i] = T(0);
}

// Calls visit(a channel of a pixel in the working memory, its index in an image of the channels).
template <class T, class Visit>
BEAGS_INLINE void for_each_feature(const Job<T>& job, int tile, Visit visit) {
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) __attribute__((always_inline)) {
    T* work = work_of(job, pack) + lane;
    for (int c = 0; c < job.num_features; ++c) visit(work[c * kLanes<T>], at * job.num_features + c);
  });
}

template <class T>
void feature_channels(const Job<T>& job, int tile) {
  clear_feature_work(job);
  Walk<T> walk(job, tile);
  composite<0>(job, tile, walk,
               [&](int, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T>)
                   __attribute__((always_inline)) {
                     const T* f = features_of(job, s);
                     T* sum = work_of(job, hits.pack[i]);
                     for (int first = 0; first < job.num_features; first += 4) {
                       BEAGS_UNROLL for (int c = 0; c < 4; ++c) {
                         T* to = sum + (first + c) * kLanes<T>;
                         store(to, fma(w, all(f[first + c]), load(to)));
                       }
                     }
                   });
  if (job.saved.end) walk.save(job.saved, tile);
  for_each_feature(job, tile, [&](T sum, int64_t at) { job.channels[at] = sum; });
}

// Fills the working memory with the gradients of the pixels' channels.
template <class T>
BEAGS_INLINE void read_feature_gradients(const Job<T>& job, int tile) {
  clear_feature_work(job);
  for_each_feature(job, tile, [&](T& gradient, int64_t at) { gradient = job.channel_gradients[at]; });
  for (int c = 0; c < job.num_features; ++c) pair_sums(job)[c] = Vector<T>{};
}

// Adds a hit of weight w to the sums of its pair. Returns dL/dw.
template <class T>
BEAGS_INLINE Real<T> add_features(const Job<T>& job, const Splat<T>& s, int pack, Real<T> w) {
  const T *f = features_of(job, s), *gradients = work_of(job, pack);
  Vector<T>* sums = pair_sums(job);
  Real<T> g_w[2] = {all(T(0)), all(T(0))};  // Two chains of dependent sums are shorter than one.
  for (int first = 0; first < job.num_features; first += 4) {
    BEAGS_UNROLL for (int c = 0; c < 4; ++c) {
      const Real<T> g = load(gradients + (first + c) * kLanes<T>);
      g_w[c % 2] = fma(g, all(f[first + c]), g_w[c % 2]);
      add(sums[first + c], w, g);
    }
  }
  return g_w[0] + g_w[1];
}

template <class T>
BEAGS_INLINE T* feature_record(const Job<T>& job, const Pair& pair) {
  return job.feature_records + static_cast<int64_t>(pair.record) * job.num_features;
}

// Writes a pair's sums and clears them.
template <class T>
BEAGS_INLINE void write_feature_record(const Job<T>& job, const Pair& pair) {
  T* record = feature_record(job, pair);
  Vector<T>* sums = pair_sums(job);
  for (int first = 0; first < job.num_features; first += 4) {
    Register<T>::sum4(sums + first, record + first);
    for (int c = 0; c < 4; ++c) sums[first + c] = Vector<T>{};
  }
}

}  // namespace BEAGS_ISA
}  // namespace beags
