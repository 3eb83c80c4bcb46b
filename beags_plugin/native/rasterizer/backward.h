// Computes the gradients of one tile, back to front (E2 to E4, E7). Included once for each instruction set.
#pragma once

#include "rasterizer/composite.h"
#include "rasterizer/features.h"
#include "rasterizer/labels.h"

namespace beags {
namespace BEAGS_ISA {

// The backward's state of a pack of pixels; g_ marks gradients of the loss.
template <class T>
struct alignas(64) PixelGradients {
  T transmittance[kLanes<T>], behind[kLanes<T>];  // behind: T times the part of dL/dT from hits behind
  T end[kLanes<T>];
  T g_color[3][kLanes<T>], g_alpha[kLanes<T>];
  T g_normal[3][kLanes<T>], g_depth[kLanes<T>], g_median_depth[kLanes<T>],
      median_pair[kLanes<T>];                                     // g_depth: gradient of sum w d
  T first[kLanes<T>], g_alpha_m[kLanes<T>], g_moment[kLanes<T>];  // distortion: its gradient times A and sum w m
  T g_boundary[kLanes<T>];
  Labels<T> labels;
};

template <Parts kWanted, class T>
BEAGS_INLINE void load_saved(const Job<T>& job, int tile, PixelGradients<T>* pixels) {
  const Saved<T>& from = job.saved;
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    PixelGradients<T>& p = pixels[pack];
    const int64_t at = saved_at<T>(tile, pack);
    store(p.transmittance, load(from.end_transmittance + at));
    store(p.end, load(from.end + at));
    if ((kWanted & kGeometry) && from.median_pair) store(p.median_pair, load(from.median_pair + at));
    if ((kWanted & kDistortion) && from.first) store(p.first, load(from.first + at));
  }
}

template <Parts kWanted, class T>
BEAGS_INLINE void prefetch_gradients(const Job<T>& job, int tile) {
  const Images<const T>& g = job.gradients;
  prefetch_image<3>(job, tile, g.color);
  prefetch_image<1>(job, tile, g.alpha);
  if (kWanted & kGeometry) {
    prefetch_image<1>(job, tile, g.depth);
    prefetch_image<1>(job, tile, g.median_depth);
    prefetch_image<3>(job, tile, g.normal);
  }
  if (kWanted & kDistortion) prefetch_image<1>(job, tile, g.distortion);
  if (kWanted & kBoundary) prefetch_image<1>(job, tile, g.boundary);
}

// Reads the gradients of the images. Returns the label of the whole tile, see load_labels.
template <Parts kWanted, class T>
BEAGS_INLINE int32_t read_gradients(const Job<T>& job, int tile, PixelGradients<T>* pixels) {
  const Images<const T>& g = job.gradients;
  const auto one = [&](const T* image, auto field) __attribute__((always_inline)) {
    if (!image) return;
    read_image<1>(job, tile, image, [&](int, int pack) __attribute__((always_inline)) { return pixels[pack].*field; });
  };
  const auto three = [&](const T* image, auto field) __attribute__((always_inline)) {
    if (!image) return;
    read_image<3>(job, tile, image,
                  [&](int c, int pack) __attribute__((always_inline)) { return (pixels[pack].*field)[c]; });
  };
  three(g.color, &PixelGradients<T>::g_color);
  one(g.alpha, &PixelGradients<T>::g_alpha);
  if (kWanted & kGeometry) {
    one(g.depth, &PixelGradients<T>::g_depth);
    one(g.median_depth, &PixelGradients<T>::g_median_depth);
    three(g.normal, &PixelGradients<T>::g_normal);
  }
  if (kWanted & kDistortion) one(g.distortion, &PixelGradients<T>::g_moment);
  if ((kWanted & kBoundary) && g.boundary) {
    one(g.boundary, &PixelGradients<T>::g_boundary);
    return load_labels(job, tile, pixels);
  }
  return Labels<T>::kMixed;
}

// Reads the gradients of the images and turns them into gradients of the sums that make the images: A is 1 - T
// at the end, which every Gaussian changes. Returns the label of the whole tile.
template <Parts kWanted, class T>
BEAGS_INLINE int32_t load_gradients(const Job<T>& job, int tile, PixelGradients<T>* pixels) {
  prefetch_gradients<kWanted>(job, tile);
  load_saved<kWanted>(job, tile, pixels);
  const int32_t everywhere = read_gradients<kWanted>(job, tile, pixels);
  Vector<T> background[4] = {};
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    PixelGradients<T>& p = pixels[pack];
    const Real<T> end = load(p.transmittance), alpha = all(T(1)) - end;
    Real<T> behind = all(T(0)), g_alpha = load(p.g_alpha);
    for (int c = 0; c < 3; ++c) {
      const Real<T> through = load(p.g_color[c]) * end;
      add(background[c], through);
      behind = fma(through, all(job.background[c]), behind);
    }
    store(p.behind, behind);
    if ((kWanted & kGeometry) && job.saved.depth_sum) {
      const Real<T> depth_sum = load(job.saved.depth_sum + saved_at<T>(tile, pack));
      const Mask<T> seen = all(T(0)) < alpha;
      const Real<T> g_depth = keep(seen, load(p.g_depth) / alpha);
      store(p.g_depth, g_depth);
      g_alpha = g_alpha - keep(seen, g_depth * depth_sum / alpha);
    }
    if ((kWanted & kDistortion) && job.saved.first) {
      const Real<T> g = load(p.g_moment);
      store(p.g_alpha_m, g * alpha);
      store(p.g_moment, g * load(job.saved.moment1 + saved_at<T>(tile, pack)));
      g_alpha = fma(g, load(job.saved.moment2 + saved_at<T>(tile, pack)), g_alpha);
    }
    store(p.g_alpha, g_alpha);
    if (kWanted & kBoundary) store(p.g_boundary, drop(p.labels.ignored(), load(p.g_boundary)));
  }
  T sums[4];
  Register<T>::sum4(background, sums);
  for (int c = 0; c < 3; ++c) job.g_background[3 * tile + c] = sums[c];
  return everywhere;
}

// Returns dL/dw of a hit, without the part from hits behind it; sets `g_hit`, the gradient of its depth.
template <Parts kWanted, class T>
BEAGS_INLINE Real<T> weight_gradient(const Job<T>& job, int k, const Splat<T>& s, const Hits<T>& hits, int i,
                                     int32_t everywhere, const PixelGradients<T>& p, Real<T> w, Vector<T>* sums,
                                     Real<T>& g_hit) {
  if constexpr (kWanted & kClassChannels) {
    return load(job.class_gradients + job.class_places[s.class_id] * kTilePixels + hits.pack[i] * kLanes<T>);
  }
  if constexpr (kWanted & kFeatures) return add_features(job, s, hits.pack[i], w);
  Real<T> g_w = load(p.g_alpha);
  for (int c = 0; c < 3; ++c) {
    const Real<T> g = load(p.g_color[c]);
    g_w = fma(g, all(s.color[c]), g_w);
    add(sums[kColor + c], w, g);
  }
  if (kWanted & kGeometry) {
    for (int c = 0; c < 3; ++c) {
      const Real<T> g = load(p.g_normal[c]);
      g_w = fma(g, all(s.normal[c]), g_w);
      add(sums[kNormal + c], w, g);
    }
    g_w = fma(load(p.g_depth), hits.get(hits.depth, i), g_w);
    const Mask<T> median = load(p.median_pair) == all(static_cast<T>(k));
    g_hit = fma(w, load(p.g_depth), keep(median, load(p.g_median_depth)));
  }
  if (kWanted & kDistortion) {
    add_distortion(job.mapping, load(p.first), hits.get(hits.nearness, i), load(p.g_alpha_m), load(p.g_moment), w, g_w,
                   g_hit);
  }
  if ((kWanted & kBoundary) && s.class_id != everywhere && !p.labels.all_right(s.class_id)) {
    g_w = g_w + drop(p.labels.right(s.class_id), load(p.g_boundary));
  }
  return g_w;
}

// Adds one Gaussian's part at one pack of pixels, back to front.
template <Parts kWanted, bool kPlain, class T>
BEAGS_INLINE void add_gradients(const Job<T>& job, int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> dx,
                                Real<T> dy, int32_t everywhere, PixelGradients<T>& p, Vector<T>* sums) {
  constexpr bool kDepths = kWanted & (kGeometry | kDistortion);
  const Real<T> alpha = hits.get(hits.alpha, i), inverse_left = all(T(1)) / (all(T(1)) - alpha);
  const Real<T> before = load(p.transmittance) * inverse_left, w = alpha * before;
  Real<T> g_hit = all(T(0));
  const Real<T> g_w = weight_gradient<kWanted>(job, k, s, hits, i, everywhere, p, w, sums, g_hit);
  store(p.transmittance, before);
  const Real<T> behind = load(p.behind);
  const Real<T> g_log = log_alpha_slope(w, g_w, behind, alpha, inverse_left);
  store(p.behind, fma(w, g_w, behind));
  add(sums[kLogOpacity], g_log);
  const Real<T> inverse = hits.get(hits.inverse, i);
  const auto plane = plane_slopes<kDepths>(g_log, g_hit, inverse, hits.get(hits.rho, i),
                                           kDepths ? hits.get(hits.depth, i) : all(T(0)));
  const Real<T> s_x = plane.s_0 * dx, s_y = plane.s_0 * dy;
  add(sums[kSx], s_x);
  add(sums[kSy], s_y);
  add(sums[kSxx], s_x, dx);
  add(sums[kSxy], s_x, dy);
  add(sums[kSyy], s_y, dy);
  add(sums[kH], plane.h);
  add(sums[kHx], plane.h, dx);
  add(sums[kHy], plane.h, dy);
  if (kDepths) add(sums[kDet], g_hit, inverse);
  if (kPlain) return;
  // Low-pass: d rho2d / dc = -4 (dx, dy); depth = p_z.
  const Mask<T> disc = inverse == all(T(0));
  const Real<T> g_disc = keep(disc, g_log + g_log);
  add(sums[kCx], g_disc, dx);
  add(sums[kCy], g_disc, dy);
  if (kDepths) add(sums[kZ], keep(disc, g_hit));
}

// Tracks, back to front, which groups of pixels have a pixel that is before its end.
template <class T>
struct Waking {
  int end[kGroupPixels] = {};  // the latest end among a group's pixels
  int next = 0;                // the largest one among the groups that sleep
  unsigned active = 0;

  explicit Waking(const PixelGradients<T>* pixels) {
    for (int i = 0; i < kTilePixels; ++i) {
      const int here = static_cast<int>(pixels[i / kLanes<T>].end[i % kLanes<T>]);
      if (here > end[i / kGroupPixels]) end[i / kGroupPixels] = here;
      if (here > next) next = here;
    }
  }
  void wake(int k) {
    next = 0;
    for (int group = 0; group < kGroupPixels; ++group) {
      if (k < end[group]) {
        active |= 1u << group;
      } else if (end[group] > next) {
        next = end[group];
      }
    }
  }
};

// Calls visit(plain, k, splat, hits, i, dx, dy, pixels of the pack, sums) for each hit that the forward composited,
// back to front, and writes each pair's record: kSize sums over the tile's pixels, and with kWithFeatures those of the
// channels.
template <int kSize, bool kWithFeatures, unsigned kNeeds, class T, class Visit>
BEAGS_INLINE void walk_back(const Job<T>& job, int tile, PixelGradients<T>* pixels, Visit visit) {
  const Centres<T> centre(job, tile);
  Waking<T> waking(pixels);
  const Pair* pairs = job.pairs + job.tile_start[tile];
  Hits<T> hits;
  for (int k = static_cast<int>(job.tile_start[tile + 1] - job.tile_start[tile]) - 1; k >= 0; --k) {
    if (k >= kPrefetched) {
      prefetch(job, pairs[k - kPrefetched]);
      const T* record = job.records + static_cast<int64_t>(pairs[k - kPrefetched].record) * kSize;
      __builtin_prefetch(record, 1);
      __builtin_prefetch(record + kSize - 1, 1);
      if (kWithFeatures) __builtin_prefetch(feature_record(job, pairs[k - kPrefetched]), 1);
    }
    if (k < waking.next) waking.wake(k);
    const Splat<T>& splat = job.splats[pairs[k].splat];
    collect<kNeeds>(job, splat, pairs[k].mask & waking.active, centre, hits,
                    [&](int pack)
                        __attribute__((always_inline)) { return all(static_cast<T>(k)) < load(pixels[pack].end); });
    Vector<T> sums[kSize ? kSize : 1] = {};
    const auto each = [&](auto plain) __attribute__((always_inline)) {
      for (int i = 0; i < hits.count; ++i) {
        const int pack = hits.pack[i];
        const Real<T> dx = centre.pack_x(pack) - all(splat.cx), dy = centre.pack_y(pack) - all(splat.cy);
        visit(plain, k, splat, hits, i, dx, dy, pixels[pack], sums);
      }
    };
    if (splat.plain) {
      each(Constant<true>{});
    } else {
      each(Constant<false>{});
    }
    T* record = job.records + static_cast<int64_t>(pairs[k].record) * kSize;
    for (int i = 0; i < kSize; i += 4) Register<T>::sum4(sums + i, record + i);
    if (kWithFeatures) write_feature_record(job, pairs[k]);
  }
}

template <Parts kWanted, class T>
void backward(const Job<T>& job, int tile) {
  PixelGradients<T> pixels[kTilePacks<T>] = {};
  if (kWanted & kFeatures) read_feature_gradients(job, tile);
  const int32_t everywhere = load_gradients<kWanted>(job, tile, pixels);
  constexpr unsigned kNeeds =
      kNeedShape | (kWanted & (kGeometry | kDistortion) ? kNeedDepth : 0) | (kWanted & kDistortion ? kNeedNearness : 0);
  const auto add = [&job, everywhere](auto plain, int k, const Splat<T>& s, const Hits<T>& hits, int i, Real<T> dx,
                                      Real<T> dy, PixelGradients<T>& p,
                                      Vector<T>* sums) __attribute__((always_inline)) {
    add_gradients<kWanted, decltype(plain)::value>(job, k, s, hits, i, dx, dy, everywhere, p, sums);
  };
  walk_back<record_size(kWanted), (kWanted & kFeatures) != 0, kNeeds>(job, tile, pixels, add);
}

// Computes the gradients of the colours and the background alone, or of the features alone: dC/dc is w, and hits behind
// do not matter.
template <bool kOfFeatures, class T>
void backward_colors(const Job<T>& job, int tile) {
  PixelGradients<T> pixels[kTilePacks<T>] = {};
  if (kOfFeatures) read_feature_gradients(job, tile);
  load_gradients<0>(job, tile, pixels);
  const auto add_colors = [&job](auto, int, const Splat<T>& s, const Hits<T>& hits, int i, Real<T>, Real<T>,
                                 PixelGradients<T>& p, Vector<T>* sums) __attribute__((always_inline)) {
    const Real<T> alpha = hits.get(hits.alpha, i), inverse_left = all(T(1)) / (all(T(1)) - alpha);
    const Real<T> before = load(p.transmittance) * inverse_left, w = alpha * before;
    store(p.transmittance, before);
    if (kOfFeatures) {
      add_features(job, s, hits.pack[i], w);
    } else {
      for (int c = 0; c < 3; ++c) add(sums[kColor + c], w, load(p.g_color[c]));
    }
  };
  walk_back<kOfFeatures ? 0 : kColorRecord, kOfFeatures, 0>(job, tile, pixels, add_colors);
}

}  // namespace BEAGS_ISA
}  // namespace beags
