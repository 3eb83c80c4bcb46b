// The images of one tile (E4, E7). Included once for each instruction set.
#pragma once

#include "composite.h"

namespace beags {
namespace BEAGS_ISA {

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

  composite(
      job, tile, transmittance,
      [&](int k, const Splat<T>& s, int pack, const Hit<T>& hit, Mask<T> on, Real<T> w, Real<T> before, Real<T> after) {
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

}  // namespace BEAGS_ISA
}  // namespace beags
