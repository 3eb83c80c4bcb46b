// The gradients of one tile, back to front (E2 to E4, E7). Included once for each instruction set.
#pragma once

#include "composite.h"

namespace beags {
namespace BEAGS_ISA {

// What the backward knows of a vector of pixels before it starts; g_ are gradients of the loss.
template <class T>
struct Gradients {
  Real<T> g_color[3], g_normal[3], g_alpha, g_depth, g_median_depth, g_distortion, g_boundary;  // g_depth: of sum w d
  Real<T> transmittance, behind;  // behind: sum over the surfels behind of w dL/dw, and the background's part
  Real<T> alpha, inverse, moment1, moment2;
  Mask<T> last, median_pair, target;
};

template <class T>
BEAGS_INLINE void load_gradients(const Job<T>& job, int tile, Gradients<T>* pixels) {
  T background[3] = {};
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    Gradients<T>& p = pixels[pack];
    p = Gradients<T>{};
    const int64_t saved = static_cast<int64_t>(tile) * kTilePixels + pack * Simd<T>::kLanes;
    p.transmittance = load(job.end_transmittance + saved);
    p.alpha = T(1) - p.transmittance;
    p.last = load_integers<T>(job.last + saved);
    if (job.geometry) p.median_pair = load_integers<T>(job.median_pair + saved);
    if (job.distortion) {
      p.inverse = load(job.first_inverse_depth + saved);
      p.moment1 = load(job.moment1 + saved);
      p.moment2 = load(job.moment2 + saved);
    }
  }
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    Gradients<T>& p = pixels[pack];
    const T alpha = p.alpha[lane];
    if (job.g_color) {
      for (int c = 0; c < 3; ++c) {
        p.g_color[c][lane] = job.g_color[3 * at + c];
        background[c] += p.g_color[c][lane] * p.transmittance[lane];
        p.behind[lane] += p.g_color[c][lane] * p.transmittance[lane] * job.background[c];
      }
    }
    if (job.g_alpha) p.g_alpha[lane] = job.g_alpha[at];
    if (job.g_depth && alpha > T(0)) {
      const T saved = job.depth_sum[static_cast<int64_t>(tile) * kTilePixels + pack * Simd<T>::kLanes + lane];
      p.g_depth[lane] = job.g_depth[at] / alpha;
      p.g_alpha[lane] -= p.g_depth[lane] * saved / alpha;
    }
    if (job.g_median_depth) p.g_median_depth[lane] = job.g_median_depth[at];
    if (job.g_normal) {
      for (int c = 0; c < 3; ++c) p.g_normal[c][lane] = job.g_normal[3 * at + c];
    }
    if (job.g_distortion) p.g_distortion[lane] = job.g_distortion[at];
    if (job.g_boundary) {
      p.target[lane] = job.target[at];
      p.g_boundary[lane] = job.target[at] == kIgnore ? T(0) : job.g_boundary[at];
    }
  });
  for (int c = 0; c < 3; ++c) job.g_background[3 * tile + c] = background[c];
}

// Adds one surfel's part at one vector of pixels, back to front.
template <class T>
BEAGS_INLINE void add_gradients(const Job<T>& job, int k, const Splat<T>& s, const Hit<T>& hit, Gradients<T>& p,
                                Real<T>* sums) {
  const Real<T> zero = {};
  const Mask<T> on = hit.on;
  const Real<T> inverse_left = T(1) / (T(1) - hit.alpha);
  const Real<T> before = p.transmittance * inverse_left;
  const Real<T> w = on ? hit.alpha * before : zero;
  const bool depths = job.g_depth || job.g_median_depth || job.g_distortion;
  const Real<T> depth = on ? hit.depth : zero + T(1);

  Real<T> g_w = p.g_alpha;
  if (job.g_color) {
    for (int c = 0; c < 3; ++c) {
      g_w = fma(p.g_color[c], zero + s.color[c], g_w);
      sums[kColor + c] = fma(w, p.g_color[c], sums[kColor + c]);
    }
  }
  if (job.g_normal) {
    for (int c = 0; c < 3; ++c) {
      g_w = fma(p.g_normal[c], zero + s.normal[c], g_w);
      sums[kNormal + c] = fma(w, p.g_normal[c], sums[kNormal + c]);
    }
  }
  if (job.g_boundary) g_w += p.target != s.class_id ? p.g_boundary : zero;
  Real<T> g_hit = zero;  // towards the hit's depth
  if (depths) {
    g_w = fma(p.g_depth, depth, g_w);
    g_hit = w * p.g_depth;
    if (job.g_median_depth) g_hit += p.median_pair == k ? p.g_median_depth : zero;
    if (job.g_distortion) {
      // sum over pairs w_i w_j (m_i - m_j)^2, by w_i and by m_i; dm/dd = k / d^2.
      const Real<T> inverse = T(1) / depth, m = job.mapping * (p.inverse - inverse);
      g_w += p.g_distortion * (m * (m * p.alpha - T(2) * p.moment1) + p.moment2);
      const Real<T> slope = T(2) * job.mapping * inverse * inverse * (m * p.alpha - p.moment1);
      g_hit = fma(w * p.g_distortion, slope, g_hit);
    }
    g_hit = on ? g_hit : zero;
  }
  const Real<T> g_alpha = before * g_w - p.behind * inverse_left;
  p.behind = fma(w, g_w, p.behind);
  p.transmittance = on ? before : p.transmittance;

  const Real<T> g_log = (on & ~hit.clamped) ? g_alpha * hit.alpha : zero;  // towards log alpha; E3: no slope at 0.99
  sums[kLogOpacity] += g_log;
  // rho3d: d rho / dq = 2 (u, v, -rho) / q2 and dL/d rho = -g_log / 2; depth = det / q2.
  const Mask<T> plane = on & hit.plane;
  const Real<T> inverse = plane ? hit.inverse : zero;
  const Real<T> scaled = g_log * inverse * inverse;
  const Real<T> g_q0 = -scaled * hit.q0, g_q1 = -scaled * hit.q1;
  const Real<T> g_q2 = (g_log * hit.rho - g_hit * depth) * inverse;
  sums[kQ0] += g_q0;
  sums[kQ0x] = fma(g_q0, hit.dx, sums[kQ0x]);
  sums[kQ0y] = fma(g_q0, hit.dy, sums[kQ0y]);
  sums[kQ1] += g_q1;
  sums[kQ1x] = fma(g_q1, hit.dx, sums[kQ1x]);
  sums[kQ1y] = fma(g_q1, hit.dy, sums[kQ1y]);
  sums[kQ2] += g_q2;
  sums[kQ2x] = fma(g_q2, hit.dx, sums[kQ2x]);
  sums[kQ2y] = fma(g_q2, hit.dy, sums[kQ2y]);
  // Low-pass: d rho2d / dc = -4 (dx, dy); depth = p_z.
  const Real<T> g_disc = plane ? zero : T(2) * g_log;
  sums[kCx] = fma(g_disc, hit.dx, sums[kCx]);
  sums[kCy] = fma(g_disc, hit.dy, sums[kCy]);
  if (depths) {
    sums[kDet] = fma(g_hit, inverse, sums[kDet]);
    sums[kZ] += plane ? zero : g_hit;
  }
}

template <class T>
void backward(const Job<T>& job, int tile) {
  static_assert(kRecordSize % 4 == 0, "sum_lanes takes four at a time");
  const Centres<T> centre(job, tile);
  Gradients<T> pixels[kTilePacks<T>];
  load_gradients(job, tile, pixels);
  int end = 0, group_end[kGroupPixels] = {};  // one past the last pair that reaches the tile, and each group
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    for (int lane = 0; lane < Simd<T>::kLanes; ++lane) {
      const int last = static_cast<int>(pixels[pack].last[lane]);
      if (last > group_end[pack / kPacks<T>]) group_end[pack / kPacks<T>] = last;
      if (last > end) end = last;
    }
  }
  const int64_t start = job.tile_start[tile];
  const int pairs = static_cast<int>(job.tile_start[tile + 1] - start);
  for (int k = pairs - 1; k >= 0; --k) {
    const Pair pair = job.pairs[start + k];
    Real<T> sums[kRecordSize] = {};
    if (k < end) {
      const Splat<T>& splat = job.splats[pair.splat];
      for (unsigned groups = pair.mask; groups; groups &= groups - 1) {
        const int group = __builtin_ctz(groups);
        if (k >= group_end[group]) continue;
        for (int pack = group * kPacks<T>; pack < (group + 1) * kPacks<T>; ++pack) {
          Hit<T> hit;
          const Mask<T> wanted = pixels[pack].last > k;
          if (!evaluate(job, splat, centre.x[pack], centre.y[pack], wanted, hit)) continue;
          add_gradients(job, k, splat, hit, pixels[pack], sums);
        }
      }
    }
    T* record = job.records + static_cast<int64_t>(pair.record) * kRecordSize;
    for (int i = 0; i < kRecordSize; i += 4) sum_lanes(sums + i, record + i);
  }
}

}  // namespace BEAGS_ISA
}  // namespace beags
