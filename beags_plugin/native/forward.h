// The images of one tile (E4, E7). Included once for each instruction set.
#pragma once

#include "composite.h"

namespace beags {
namespace BEAGS_ISA {

// Sums of one pack of pixels.
template <class T>
struct alignas(64) Pixels {
  T color[3][kLanes<T>], normal[3][kLanes<T>], depth[kLanes<T>];
  T median_depth[kLanes<T>], median_pair[kLanes<T>];
  T first[kLanes<T>], moment1[kLanes<T>], moment2[kLanes<T>];
  T boundary[kLanes<T>], target[kLanes<T>];
};

template <class T>
BEAGS_INLINE void accumulate(T* sum, Real<T> w, T value) {
  store(sum, fma(w, all(value), load(sum)));
}

template <Parts kWanted, class T>
BEAGS_INLINE void add_hit(int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T> before,
                          Pixels<T>& p) {
  for (int c = 0; c < 3; ++c) accumulate(p.color[c], w, s.color[c]);
  if (kWanted & kGeometry) {
    for (int c = 0; c < 3; ++c) accumulate(p.normal[c], w, s.normal[c]);
    const Real<T> depth = hits.get(hits.depth, i);
    store(p.depth, fma(w, depth, load(p.depth)));
    // The last hit in front of which T > 0.5: where T ends below that, it is the one at which T passes 0.5.
    const Mask<T> passes = all(T(0)) < keep(all(T(0.5)) < before, w);
    store(p.median_depth, select(passes, depth, load(p.median_depth)));
    store(p.median_pair, select(passes, all(static_cast<T>(k)), load(p.median_pair)));
  }
  if (kWanted & kDistortion) {
    const Real<T> nearness = keep(all(T(0)) < w, hits.get(hits.nearness, i));
    const Real<T> seen = load(p.first), first = select(seen == all(T(0)), nearness, seen);
    store(p.first, first);
    const Real<T> m = first - nearness;  // m_i - m_first: the differences are all that counts
    const Real<T> wm = w * m;
    store(p.moment1, load(p.moment1) + wm);
    store(p.moment2, fma(wm, m, load(p.moment2)));
  }
  if (kWanted & kBoundary) {
    const Mask<T> right = load(p.target) == all(static_cast<T>(s.class_id));  // E7
    store(p.boundary, load(p.boundary) + drop(right, w));
  }
}

template <Parts kWanted, class T>
BEAGS_INLINE void save(const Job<T>& job, int tile, const Walk<T>& walk, const Pixels<T>* pixels) {
  const Saved<T>& to = job.saved;
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    const Pixels<T>& p = pixels[pack];
    const int64_t at = saved_at<T>(tile, pack);
    store(to.end_transmittance + at, load(walk.transmittance + pack * kLanes<T>));
    store(to.end + at, load(walk.end + pack * kLanes<T>));
    if ((kWanted & kGeometry) && to.depth_sum) {
      store(to.depth_sum + at, load(p.depth));
      store(to.median_pair + at, load(p.median_pair));
    }
    if ((kWanted & kDistortion) && to.first) {
      store(to.first + at, load(p.first));
      store(to.moment1 + at, load(p.moment1));
      store(to.moment2 + at, load(p.moment2));
    }
  }
}

template <Parts kWanted, class T>
void forward(const Job<T>& job, int tile) {
  Walk<T> walk(job, tile);
  Pixels<T> pixels[kTilePacks<T>] = {};
  if ((kWanted & kBoundary) && job.target) {
    for_each_pixel(job, tile,
                   [&](int64_t at, int pack, int lane) { pixels[pack].target[lane] = static_cast<T>(job.target[at]); });
  }
  constexpr unsigned kNeeds = (kWanted & kGeometry ? kNeedDepth : 0) | (kWanted & kDistortion ? kNeedNearness : 0);
  composite<kNeeds>(
      job, tile, walk,
      [&](int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T> before)
          __attribute__((always_inline)) { add_hit<kWanted>(k, s, hits, i, w, before, pixels[hits.pack[i]]); });
  if (kWanted & kGeometry) {
    for (int pack = 0; pack < kTilePacks<T>; ++pack) {
      Pixels<T>& p = pixels[pack];
      const Mask<T> never = all(T(0.5)) < load(walk.transmittance + pack * kLanes<T>);
      store(p.median_depth, drop(never, load(p.median_depth)));
      store(p.median_pair, select(never, all(T(-1)), load(p.median_pair)));
    }
  }
  if (job.saved.end) save<kWanted>(job, tile, walk, pixels);
  const Images<T>& to = job.images;
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const Pixels<T>& p = pixels[pack];
    const T end = walk.transmittance[pack * kLanes<T> + lane], alpha = T(1) - end;  // E4: A = sum w = 1 - T
    for (int c = 0; c < 3; ++c) to.color[3 * at + c] = p.color[c][lane] + end * job.background[c];
    to.alpha[at] = alpha;
    if ((kWanted & kGeometry) && to.depth) {
      to.depth[at] = alpha > T(0) ? p.depth[lane] / alpha : T(0);
      to.median_depth[at] = p.median_depth[lane];
      for (int c = 0; c < 3; ++c) to.normal[3 * at + c] = p.normal[c][lane];
    }
    if ((kWanted & kDistortion) && to.distortion) {
      // The sum over pairs, closed: A sum(w m^2) - (sum w m)^2; rounding must not make it negative.
      const T value = alpha * p.moment2[lane] - p.moment1[lane] * p.moment1[lane];
      to.distortion[at] = value > T(0) ? value : T(0);
    }
    if ((kWanted & kBoundary) && to.boundary) {
      to.boundary[at] = p.target[lane] == static_cast<T>(kIgnore) ? T(0) : p.boundary[lane];
    }
  });
}

}  // namespace BEAGS_ISA
}  // namespace beags
