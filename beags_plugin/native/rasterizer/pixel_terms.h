// Evaluates a Gaussian at a pixel, and its slopes (E2 to E4), for the vectors of CPUs and the threads of GPUs, so that
// both round alike. R, M: numbers and masks; on a CPU vectors of a pack of pixels, on a GPU one pixel's.
#pragma once

#include "rasterizer/types.h"
#include "simd/device.h"
#if defined(__CUDACC__) || defined(BEAGS_CUDA_EMULATION)
#include "simd/scalar_math.h"
#else
#include "rasterizer/packs.h"
#endif

namespace beags {
namespace BEAGS_ISA {

// on: the lanes where it contributes; in other lanes the numbers have no meaning.
template <class R, class M>
struct GaussianHit {
  M on;
  R alpha, depth, nearness;  // d and k / d of the hit
  R inverse;                 // 1 / q2, and 0 where the low-pass wins over rho3d
  R rho;
};

// Evaluates a splat. plain: s.plain; such a splat needs neither the low-pass nor the near plane nor alpha's maximum.
// The forward and the backward must agree in every bit: fused operations are explicit, and compilers may make no
// others.
template <class T, class R, class M, class Plain>
BEAGS_HD_INLINE GaussianHit<R, M> gaussian_hit(const Splat<T>& s, T near_plane, R dx, R dy, M wanted, Plain plain) {
  const R q0 = fma(all(s.u_y), dy, all(s.u_x) * dx);  // E2
  const R q1 = fma(all(s.v_y), dy, all(s.v_x) * dx);
  const R q2 = fma(all(s.w_y), dy, fma(all(s.w_x), dx, all(s.w_0)));
  R inverse = all(T(1)) / q2;
  const R u = q0 * inverse, v = q1 * inverse;
  R rho = fma(u, u, v * v), depth = all(s.det) * inverse, nearness = all(s.nearness_det) * q2;
  if (!plain) {
    const R half = fma(dy, dy, dx * dx), rho2d = half + half;
    const M plane = rho <= rho2d;  // This is false for NaN, at the centre of an edge-on Gaussian.
    rho = min(rho, rho2d);
    inverse = keep(plane, inverse);
    depth = select(plane, depth, all(s.z));
    nearness = select(plane, nearness, all(s.nearness_z));
  }
  const R exponent = fma(all(T(-0.5 / kLn2)), rho, all(s.log2_opacity));
  M on = wanted & (all(T(kLog2MinAlpha)) <= exponent);
  if (!plain) on = on & (all(near_plane) <= depth);
  R alpha = exp2(exponent);  // E3
  if (!plain) alpha = min(alpha, all(T(kMaxAlpha)));
  return {on, alpha, depth, nearness, inverse, rho};
}

// Adds the distortion's slopes to dL/dw and to the gradient of the hit's depth. The distortion is the sum over pairs of
// w_i w_j (m_i - m_j)^2. Its derivative with respect to w_i is m (m A - 2 sum w m) + sum w m^2, whose last term g_alpha
// has, and with respect to m_i it is 2 w_i (m A - sum w m); dm/dd = k / d^2. m is relative to that of the first hit.
template <class T, class R>
BEAGS_HD_INLINE void add_distortion(T mapping, R first, R nearness, R g_alpha_m, R g_moment, R w, R& g_w, R& g_hit) {
  const R m = first - nearness, slope = m * g_alpha_m - g_moment;
  g_w = fma(m, slope - g_moment, g_w);
  g_hit = fma(w * slope, all(T(2) / mapping) * (nearness * nearness), g_hit);
}

// Returns dL/d log alpha = alpha dL/dalpha = w g_w - (the part behind) alpha / (1 - alpha), at the clamp of E3 too.
// inverse_left: 1 / (1 - alpha).
template <class R>
BEAGS_HD_INLINE R log_alpha_slope(R w, R g_w, R behind, R alpha, R inverse_left) {
  return w * g_w - behind * (alpha * inverse_left);
}

// The derivatives of the plane's hit with respect to q: d rho / dq = 2 (u, v, -rho) / q2 and dL/d rho = -g_log / 2;
// depth = det / q2.
template <class R>
struct PlaneSlopes {
  R s_0, h;  // derivative with respect to (q0, q1) over (u, v), and to q2
};
template <bool kDepths, class R>
BEAGS_HD_INLINE PlaneSlopes<R> plane_slopes(R g_log, R g_hit, R inverse, R rho, R depth) {
  R along = g_log * rho;
  if (kDepths) along = along - g_hit * depth;
  return {g_log * (inverse * inverse), along * inverse};
}

}  // namespace BEAGS_ISA
}  // namespace beags
