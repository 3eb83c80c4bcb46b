// The kernels of one tile, forward and backward (E2 to E4, E7). Included once for each instruction set.
#pragma once

#include "simd.h"
#include "types.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
constexpr int kPacks = kGroupPixels / Simd<T>::kLanes;  // vectors in a group of 4 x 4 pixels
template <class T>
constexpr int kTilePacks = kGroupPixels * kPacks<T>;

template <class T>
BEAGS_INLINE Real<T> load(const T* from) {
  Real<T> value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}
template <class T>
BEAGS_INLINE void store(T* to, Real<T> value) {
  __builtin_memcpy(to, &value, sizeof value);
}
// int32 in memory, lanes as wide as T in registers.
template <class T>
BEAGS_INLINE Mask<T> load_integers(const int32_t* from) {
  Mask<T> value;
  for (int lane = 0; lane < Simd<T>::kLanes; ++lane) value[lane] = from[lane];
  return value;
}
template <class T>
BEAGS_INLINE void store_integers(int32_t* to, Mask<T> value) {
  for (int lane = 0; lane < Simd<T>::kLanes; ++lane) to[lane] = static_cast<int32_t>(value[lane]);
}

// Where a lane of a tile lies in the image.
struct Place {
  int x, y;
};
template <class T>
BEAGS_INLINE Place place(const Job<T>& job, int tile, int pack, int lane) {
  const int group = pack / kPacks<T>, pixel = (pack % kPacks<T>)*Simd<T>::kLanes + lane;
  return {tile % job.tiles_x * kTile + group % kGroup * kGroup + pixel % kGroup,
          tile / job.tiles_x * kTile + group / kGroup * kGroup + pixel / kGroup};
}

// Calls visit(lane's index into the image, pack, lane) for the lanes inside the image, in a fixed order.
template <class T, class Visit>
BEAGS_INLINE void for_each_pixel(const Job<T>& job, int tile, Visit visit) {
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    for (int lane = 0; lane < Simd<T>::kLanes; ++lane) {
      const Place at = place(job, tile, pack, lane);
      if (at.x < job.width && at.y < job.height) visit(static_cast<int64_t>(at.y) * job.width + at.x, pack, lane);
    }
  }
}

// Pixel centres (the pixel plus 0.5).
template <class T>
struct Centres {
  Real<T> x[kTilePacks<T>], y[kTilePacks<T>];

  Centres(const Job<T>& job, int tile) {
    for (int pack = 0; pack < kTilePacks<T>; ++pack) {
      for (int lane = 0; lane < Simd<T>::kLanes; ++lane) {
        const Place at = place(job, tile, pack, lane);
        x[pack][lane] = at.x + T(0.5);
        y[pack][lane] = at.y + T(0.5);
      }
    }
  }
};

// One surfel at the pixels of one vector.
template <class T>
struct Hit {
  Real<T> dx, dy, q0, q1, inverse;  // inverse = 1 / q2: only where `plane`
  Real<T> rho, depth, alpha;
  Mask<T> on;       // it contributes
  Mask<T> plane;    // rho3d wins; else the low-pass does
  Mask<T> clamped;  // alpha was above its maximum
};

// False if it contributes to no lane of `wanted`. The forward and the backward must agree in every bit.
template <class T>
BEAGS_INLINE bool evaluate(const Job<T>& job, const Splat<T>& s, Real<T> x, Real<T> y, Mask<T> wanted, Hit<T>& hit) {
  const Real<T> zero = {};
  hit.dx = x - s.cx;
  hit.dy = y - s.cy;
  hit.q0 = fma(zero + s.u_x, hit.dx, s.u_y * hit.dy);  // E2
  hit.q1 = fma(zero + s.v_x, hit.dx, s.v_y * hit.dy);
  const Real<T> q2 = fma(zero + s.w_x, hit.dx, fma(zero + s.w_y, hit.dy, zero + s.w_0));
  hit.inverse = T(1) / q2;
  const Real<T> u = hit.q0 * hit.inverse, v = hit.q1 * hit.inverse;
  const Real<T> rho3d = fma(u, u, v * v);
  const Real<T> rho2d = T(2) * fma(hit.dx, hit.dx, hit.dy * hit.dy);
  hit.plane = rho3d <= rho2d;  // false for NaN: an edge-on surfel at its centre
  hit.rho = hit.plane ? rho3d : rho2d;
  hit.depth = hit.plane ? s.det * hit.inverse : zero + s.z;
  const Real<T> exponent = fma(zero - T(0.5), hit.rho, zero + s.log_opacity);
  hit.on = wanted & (exponent >= T(kLogMinAlpha)) & (hit.depth >= job.near_plane);
  if (!any(hit.on)) return false;
  const Real<T> alpha = exponential(exponent);  // E3
  hit.clamped = alpha > T(kMaxAlpha);
  hit.alpha = hit.clamped ? zero + T(kMaxAlpha) : alpha;
  return true;
}

// Composites a tile front to back: calls visit(k, splat, pack, hit, on, w, before, after) for each surfel and vector of
// pixels that it reaches; k counts pairs within the tile, on are the lanes it adds to, w = 0 elsewhere; before and after
// are T. Leaves T in `transmittance`.
template <class T, class Visit>
BEAGS_INLINE void composite(const Job<T>& job, int tile, Real<T>* transmittance, Visit visit) {
  const Centres<T> centre(job, tile);
  Mask<T> live[kTilePacks<T>];
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    live[pack] = Mask<T>{};
    transmittance[pack] = Real<T>{} + T(1);
  }
  unsigned active = 0;  // groups with a live pixel
  for_each_pixel(job, tile, [&](int64_t, int pack, int lane) {
    live[pack][lane] = -1;
    active |= 1u << (pack / kPacks<T>);
  });
  const int64_t start = job.tile_start[tile];
  const int pairs = static_cast<int>(job.tile_start[tile + 1] - start);
  for (int k = 0; k < pairs && active; ++k) {
    const Pair pair = job.pairs[start + k];
    const Splat<T>& splat = job.splats[pair.splat];
    for (unsigned groups = pair.mask & active; groups; groups &= groups - 1) {
      const int group = __builtin_ctz(groups);
      bool stopped = false;
      for (int pack = group * kPacks<T>; pack < (group + 1) * kPacks<T>; ++pack) {
        Hit<T> hit;
        if (!evaluate(job, splat, centre.x[pack], centre.y[pack], live[pack], hit)) continue;
        const Real<T> before = transmittance[pack], after = before * (T(1) - hit.alpha);
        const Mask<T> stop = hit.on & (after < T(kMinTransmittance));
        if (any(stop)) {
          live[pack] &= ~stop;
          stopped = true;
        }
        const Mask<T> on = hit.on & ~stop;
        const Real<T> w = on ? hit.alpha * before : Real<T>{};
        visit(k, splat, pack, hit, on, w, before, after);
        transmittance[pack] = on ? after : before;
      }
      if (stopped) {
        Mask<T> left = live[group * kPacks<T>];
        for (int i = 1; i < kPacks<T>; ++i) left |= live[group * kPacks<T> + i];
        if (!any(left)) active &= ~(1u << group);
      }
    }
  }
}

template <class T>
void forward(const Job<T>& job, int tile) {
  struct Pixels {
    Real<T> color[3], normal[3], depth, median_depth, inverse, moment1, moment2, boundary;
    Mask<T> last, median_pair, target;
  };
  Pixels pixels[kTilePacks<T>];
  Real<T> transmittance[kTilePacks<T>];
  for (Pixels& p : pixels) {
    p = Pixels{};
    p.median_pair = ~p.median_pair;  // -1
    p.target += kIgnore;
  }
  if (job.target) {
    for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) { pixels[pack].target[lane] = job.target[at]; });
  }

  composite(job, tile, transmittance, [&](int k, const Splat<T>& s, int pack, const Hit<T>& hit, Mask<T> on, Real<T> w,
                                          Real<T> before, Real<T> after) {
    Pixels& p = pixels[pack];
    const Mask<T> zero = {};
    p.last = on ? zero + (k + 1) : p.last;
    for (int c = 0; c < 3; ++c) p.color[c] = fma(w, Real<T>{} + s.color[c], p.color[c]);
    if (job.geometry) {
      for (int c = 0; c < 3; ++c) p.normal[c] = fma(w, Real<T>{} + s.normal[c], p.normal[c]);
      const Real<T> depth = on ? hit.depth : Real<T>{};  // where it is off, it may be infinite
      p.depth = fma(w, depth, p.depth);
      const Mask<T> passes = on & (before > T(0.5)) & (after <= T(0.5));
      p.median_depth = passes ? depth : p.median_depth;
      p.median_pair = passes ? zero + k : p.median_pair;
    }
    if (job.distortion) {
      const Real<T> inverse = T(1) / (on ? hit.depth : Real<T>{} + T(1));
      p.inverse = on & (p.inverse == T(0)) ? inverse : p.inverse;
      const Real<T> m = job.mapping * (p.inverse - inverse);  // m_i - m_first: the differences are all that counts
      p.moment1 = fma(w, m, p.moment1);
      p.moment2 = fma(w, m * m, p.moment2);
    }
    if (job.target) {
      const Mask<T> wrong = (p.target != s.class_id) & (p.target != kIgnore);  // E7
      p.boundary += wrong ? w : Real<T>{};
    }
  });

  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    const Pixels& p = pixels[pack];
    const int64_t saved = static_cast<int64_t>(tile) * kTilePixels + pack * Simd<T>::kLanes;
    store(job.end_transmittance + saved, transmittance[pack]);
    store_integers<T>(job.last + saved, p.last);
    if (job.geometry) {
      store(job.depth_sum + saved, p.depth);
      store_integers<T>(job.median_pair + saved, p.median_pair);
    }
    if (job.distortion) {
      store(job.first_inverse_depth + saved, p.inverse);
      store(job.moment1 + saved, p.moment1);
      store(job.moment2 + saved, p.moment2);
    }
  }
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    const Pixels& p = pixels[pack];
    const T end = transmittance[pack][lane], alpha = T(1) - end;  // E4: A = sum w = 1 - T
    for (int c = 0; c < 3; ++c) job.color[3 * at + c] = p.color[c][lane] + end * job.background[c];
    job.alpha[at] = alpha;
    if (job.geometry) {
      job.depth[at] = alpha > T(0) ? p.depth[lane] / alpha : T(0);
      job.median_depth[at] = p.median_depth[lane];
      for (int c = 0; c < 3; ++c) job.normal[3 * at + c] = p.normal[c][lane];
    }
    if (job.distortion) {
      // The sum over pairs, closed: A sum(w m^2) - (sum w m)^2; rounding must not make it negative.
      const T value = alpha * p.moment2[lane] - p.moment1[lane] * p.moment1[lane];
      job.distortion_out[at] = value > T(0) ? value : T(0);
    }
    if (job.boundary) job.boundary[at] = p.boundary[lane];
  });
}

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
