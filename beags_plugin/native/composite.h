// One surfel at a few pixels, and the walk through a tile front to back (E2, E3). Included once for each instruction
// set.
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
// pixels that it reaches; k counts pairs within the tile, on are the lanes it adds to, w = 0 elsewhere; before and
// after are T. Leaves T in `transmittance`.
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

}  // namespace BEAGS_ISA
}  // namespace beags
