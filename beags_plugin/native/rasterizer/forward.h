// Computes the images of one tile (E4, E7). Included once for each instruction set.
#pragma once

#include "rasterizer/composite.h"
#include "rasterizer/labels.h"

namespace beags {
namespace BEAGS_ISA {

// Sums of one pack of pixels.
template <class T>
struct alignas(64) Pixels {
  T color[3][kLanes<T>], alpha[kLanes<T>], normal[3][kLanes<T>], depth[kLanes<T>];
  T median_depth[kLanes<T>], median_pair[kLanes<T>];
  T first[kLanes<T>], moment1[kLanes<T>], moment2[kLanes<T>], distortion[kLanes<T>];
  T boundary[kLanes<T>];
  Labels<T> labels;
};

template <class T>
BEAGS_INLINE void accumulate(T* sum, Real<T> w, T value) {
  store(sum, fma(w, all(value), load(sum)));
}

// Adds a hit to the sums. everywhere: the label of the whole tile, see load_labels; with it, most hits skip their
// pack's labels.
template <Parts kWanted, class T>
BEAGS_INLINE void add_hit(int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T> before,
                          int32_t everywhere, Pixels<T>& p) {
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
    const Real<T> m = first - nearness;  // m_i - m_first: only differences count
    const Real<T> wm = w * m;
    store(p.moment1, load(p.moment1) + wm);
    store(p.moment2, fma(wm, m, load(p.moment2)));
  }
  if ((kWanted & kBoundary) && s.class_id != everywhere && !p.labels.all_right(s.class_id)) {
    store(p.boundary, load(p.boundary) + drop(p.labels.right(s.class_id), w));  // E7
  }
}

template <Parts kWanted, class T>
BEAGS_INLINE void save(const Job<T>& job, int tile, const Walk<T>& walk, const Pixels<T>* pixels) {
  const Saved<T>& to = job.saved;
  walk.save(to, tile);
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    const Pixels<T>& p = pixels[pack];
    const int64_t at = saved_at<T>(tile, pack);
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

// Clears the median where T stays above 0.5.
template <class T>
BEAGS_INLINE void finish_median(const Walk<T>& walk, Pixels<T>* pixels) {
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    Pixels<T>& p = pixels[pack];
    const Mask<T> never = all(T(0.5)) < load(walk.transmittance + pack * kLanes<T>);
    store(p.median_depth, drop(never, load(p.median_depth)));
    store(p.median_pair, select(never, all(T(-1)), load(p.median_pair)));
  }
}

// Turns a pack's sums into the values of its pixels, in place. end: T behind the last Gaussian.
template <Parts kWanted, class T>
BEAGS_INLINE void finish(const Job<T>& job, Real<T> end, Pixels<T>& p) {
  const Real<T> alpha = all(T(1)) - end;  // E4: A = sum w = 1 - T
  store(p.alpha, alpha);
  for (int c = 0; c < 3; ++c) store(p.color[c], load(p.color[c]) + end * all(job.background[c]));
  if (kWanted & kGeometry) store(p.depth, keep(all(T(0)) < alpha, load(p.depth) / alpha));
  if (kWanted & kDistortion) {
    // The sum over pairs in closed form, A sum(w m^2) - (sum w m)^2; rounding must not make it negative.
    const Real<T> moment1 = load(p.moment1), value = alpha * load(p.moment2) - moment1 * moment1;
    store(p.distortion, keep(all(T(0)) < value, value));
  }
  if (kWanted & kBoundary) store(p.boundary, drop(p.labels.ignored(), load(p.boundary)));
}

template <Parts kWanted, class T>
BEAGS_INLINE void write(const Job<T>& job, int tile, const Pixels<T>* pixels) {
  const Images<T>& to = job.images;
  const auto one = [&](T* image, auto field) __attribute__((always_inline)) {
    write_image<1>(job, tile, image, [&](int, int pack) __attribute__((always_inline)) { return pixels[pack].*field; });
  };
  const auto three = [&](T* image, auto field) __attribute__((always_inline)) {
    write_image<3>(job, tile, image,
                   [&](int c, int pack) __attribute__((always_inline)) { return (pixels[pack].*field)[c]; });
  };
  three(to.color, &Pixels<T>::color);
  one(to.alpha, &Pixels<T>::alpha);
  if ((kWanted & kGeometry) && to.depth) {
    one(to.depth, &Pixels<T>::depth);
    one(to.median_depth, &Pixels<T>::median_depth);
    three(to.normal, &Pixels<T>::normal);
  }
  if ((kWanted & kDistortion) && to.distortion) one(to.distortion, &Pixels<T>::distortion);
  if ((kWanted & kBoundary) && to.boundary) one(to.boundary, &Pixels<T>::boundary);
}

template <Parts kWanted, class T>
void forward(const Job<T>& job, int tile) {
  Walk<T> walk(job, tile);
  Pixels<T> pixels[kTilePacks<T>] = {};
  int32_t everywhere = Labels<T>::kMixed;
  if ((kWanted & kBoundary) && job.target) everywhere = load_labels(job, tile, pixels);
  constexpr unsigned kNeeds = (kWanted & kGeometry ? kNeedDepth : 0) | (kWanted & kDistortion ? kNeedNearness : 0);
  composite<kNeeds>(job, tile, walk,
                    [&](int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> w, Real<T> before)
                        __attribute__((always_inline)) {
                          add_hit<kWanted>(k, s, hits, i, w, before, everywhere, pixels[hits.pack[i]]);
                        });
  if (kWanted & kGeometry) finish_median(walk, pixels);
  if (job.saved.end) save<kWanted>(job, tile, walk, pixels);
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    finish<kWanted>(job, load(walk.transmittance + pack * kLanes<T>), pixels[pack]);
  }
  write<kWanted>(job, tile, pixels);
}

}  // namespace BEAGS_ISA
}  // namespace beags
