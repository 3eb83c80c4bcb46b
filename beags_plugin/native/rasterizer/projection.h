// Projects one Gaussian into one view, and its gradient back, on the CPU and on GPUs. All is float64, which costs
// little compared with the tiles, and gives float32 images only the tiles' rounding.
#pragma once

#include <algorithm>
#include <cmath>

#include "rasterizer/quaternion.h"
#include "rasterizer/types.h"
#include "simd/device.h"

namespace beags {

struct View {
  double rotation[9];  // world to camera, row-major
  double translation[3];
  double kx[3], ky[3];  // first two rows of K; the third is (0, 0, 1)
  int width, height;    // pixels
  double near_plane, far_plane;

  // Returns k of the distortion's m(d) = far / (far - near) - k / d: far near / (far - near).
  BEAGS_HD double mapping() const { return near_plane / (1 - near_plane / far_plane); }
};

struct GaussianParameters {
  double mean[3], quat[4], scale[2];
  double log2_opacity, transparency;  // transparency: 1 - opacity
};

struct ShapeGradients {
  double mean[3], quat[4], log_scale[2];
  double screen_shift[2];  // see rasterizers/interface.py
};

enum class Fate { kRendered, kCulled, kNonFinite };

// Parts of the functions below.
BEAGS_HD inline double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

BEAGS_HD inline void multiply(const double* m, const double* v, double* out) {  // out = m v
  for (int i = 0; i < 3; ++i) out[i] = dot(m + 3 * i, v);
}

BEAGS_HD inline void multiply_transposed(const double* m, const double* v, double* out) {  // out = m^T v
  for (int i = 0; i < 3; ++i) out[i] = m[i] * v[0] + m[3 + i] * v[1] + m[6 + i] * v[2];
}

template <class... Numbers>
BEAGS_HD bool finite(Numbers... numbers) {
  return ((0 * numbers) + ...) == 0;  // A single comparison tests all.
}

// The Gaussian in camera space (E1): a, b and p divided by p_z, its centre's depth.
struct Placement {
  double inverse_length, unit[4];          // the quaternion q: 1 / |q|, q / |q|
  double axis_u[3], axis_v[3], axis_n[3];  // columns of R
  double z, inverse_z, a[3], b[3], p[3];
  double cx, cy;             // projected centre
  double mu[2], mv[2];       // first two columns of the recentred rows Mx, My; their third is 0
  double normal[3], facing;  // facing: +1 or -1, turns the normal towards the camera
};

BEAGS_HD inline void place(const View& view, const GaussianParameters& s, Placement& at) {
  at.inverse_length = 1 / std::sqrt(s.quat[0] * s.quat[0] + dot(s.quat + 1, s.quat + 1));
  for (int i = 0; i < 4; ++i) at.unit[i] = s.quat[i] * at.inverse_length;
  const double w = at.unit[0], x = at.unit[1], y = at.unit[2], z = at.unit[3];
  const double columns[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
                                {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
                                {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}};
  for (int i = 0; i < 3; ++i) {
    at.axis_u[i] = columns[0][i];
    at.axis_v[i] = columns[1][i];
    at.axis_n[i] = columns[2][i];
  }

  double center[3], a[3], b[3];
  multiply(view.rotation, s.mean, center);
  for (int i = 0; i < 3; ++i) center[i] += view.translation[i];
  multiply(view.rotation, at.axis_u, a);
  multiply(view.rotation, at.axis_v, b);
  multiply(view.rotation, at.axis_n, at.normal);
  at.facing = dot(at.normal, center) > 0 ? -1.0 : 1.0;
  at.z = center[2];
  at.inverse_z = 1 / at.z;
  const double scale_u = s.scale[0] * at.inverse_z, scale_v = s.scale[1] * at.inverse_z;
  for (int i = 0; i < 3; ++i) {
    at.normal[i] *= at.facing;
    at.p[i] = center[i] * at.inverse_z;
    at.a[i] = a[i] * scale_u;
    at.b[i] = b[i] * scale_v;
  }
  at.cx = dot(view.kx, at.p);
  at.cy = dot(view.ky, at.p);
  at.mu[0] = dot(view.kx, at.a) - at.cx * at.a[2];
  at.mu[1] = dot(view.kx, at.b) - at.cx * at.b[2];
  at.mv[0] = dot(view.ky, at.a) - at.cy * at.a[2];
  at.mv[1] = dot(view.ky, at.b) - at.cy * at.b[2];
}

// Returns whether rho3d <= rho2d wherever it is rendered, it lies wholly beyond the near plane and its alpha stays
// below the maximum. For such Gaussians, which are most, the kernels skip these tests.
BEAGS_HD inline bool is_plain(const View& view, const Splat<double>& s) {
  constexpr double kMargin = 1e-4;  // float32's rounding
  constexpr double kLog2MaxAlpha = -0.0144995696951151;
  const double squared_disc = kLn2 * (s.log2_opacity - kLog2MinAlpha);  // squared radius of the low-pass disc
  // The least |q2| within this radius of the centre, and a bound of |(q0, q1)| there: rho3d <= rho2d on all of the
  // disc. Beyond it, the low-pass is too faint to be rendered.
  const double least = std::abs(s.w_0) - std::sqrt(squared_disc * (s.w_x * s.w_x + s.w_y * s.w_y));
  const double squares = s.u_x * s.u_x + s.u_y * s.u_y + s.v_x * s.v_x + s.v_y * s.v_y;
  const double area = s.u_x * s.v_y - s.u_y * s.v_x;
  const double stretch = (squares + std::sqrt(std::max(0.0, squares * squares - 4 * area * area))) / 2;
  if (!(least > 0) || !(stretch * (1 + kMargin) < 2 * least * least)) return false;
  // The nearest point of the Gaussian's own disc, which is sqrt(2) times as many standard deviations wide.
  const double nearest = 1 - std::sqrt(2 * squared_disc * (s.tilt_u * s.tilt_u + s.tilt_v * s.tilt_v));
  if (!(s.z * nearest > view.near_plane * (1 + kMargin))) return false;
  return s.log2_opacity < kLog2MaxAlpha - kMargin && finite(s.nearness_det);
}

// Fills `splat`, except for colour and class, if the Gaussian is rendered.
BEAGS_HD inline Fate project(const View& view, const GaussianParameters& s, Splat<double>& splat) {
  Placement at;
  place(view, s, at);
  if (!usable_quaternion(at.inverse_length)) return Fate::kNonFinite;
  if (!finite(at.unit[0], s.scale[0], s.scale[1], at.z)) return Fate::kNonFinite;  // It overflowed.
  if (at.z > kLargest || s.scale[0] > kLargest || s.scale[1] > kLargest) return Fate::kNonFinite;
  if (at.z <= view.near_plane || s.log2_opacity < kLog2MinAlpha) return Fate::kCulled;
  splat.log2_opacity = s.log2_opacity;
  splat.cx = at.cx;
  splat.cy = at.cy;
  splat.u_x = at.mv[1];  // E2: q = k x l, expanded in (dx, dy)
  splat.u_y = -at.mu[1];
  splat.v_x = -at.mv[0];
  splat.v_y = at.mu[0];
  splat.w_x = at.mv[0] * at.b[2] - at.mv[1] * at.a[2];
  splat.w_y = at.a[2] * at.mu[1] - at.b[2] * at.mu[0];
  splat.w_0 = at.mu[0] * at.mv[1] - at.mu[1] * at.mv[0];
  splat.det = at.z * splat.w_0;
  splat.z = at.z;
  splat.nearness_det = view.mapping() / splat.det;
  splat.nearness_z = view.mapping() * at.inverse_z;
  splat.tilt_u = at.a[2];
  splat.tilt_v = at.b[2];
  for (int i = 0; i < 3; ++i) splat.normal[i] = at.normal[i];
  if (!finite(splat.cx, splat.cy, splat.u_x, splat.u_y, splat.v_x, splat.v_y, splat.w_x, splat.w_y, splat.w_0,
              splat.det)) {
    return Fate::kNonFinite;
  }
  splat.plain = is_plain(view, splat);
  return Fate::kRendered;
}

// Returns the gradient of mean, quat, log_scale and screen shift, from that of the splat's fields (`record`: kRecord
// sums).
BEAGS_HD inline ShapeGradients project_backward(const View& view, const GaussianParameters& s, const double* record) {
  Placement at;
  place(view, s, at);
  const double *mu = at.mu, *mv = at.mv;
  const double w_x = mv[0] * at.b[2] - mv[1] * at.a[2];
  const double w_y = at.a[2] * mu[1] - at.b[2] * mu[0];
  const double w_0 = mu[0] * mv[1] - mu[1] * mv[0];

  // The gradients of q0, q1 and q2 (sums over pixels, times 1, dx, dy): -s (q0, q1) and h, with q0 = mv1 dx - mu1 dy
  // and q1 = -mv0 dx + mu0 dy.
  const double* g = record;
  const double q0[3] = {mu[1] * g[kSy] - mv[1] * g[kSx], mu[1] * g[kSxy] - mv[1] * g[kSxx],
                        mu[1] * g[kSyy] - mv[1] * g[kSxy]};
  const double q1[3] = {mv[0] * g[kSx] - mu[0] * g[kSy], mv[0] * g[kSxx] - mu[0] * g[kSxy],
                        mv[0] * g[kSxy] - mu[0] * g[kSyy]};
  const double* q2 = g + kH;
  // dx = x - cx: the centre moves every pixel's q (and, apart from that, the low-pass disc).
  const double g_cx = -(mv[1] * q0[0] - mv[0] * q1[0] + w_x * q2[0]);
  const double g_cy = -(-mu[1] * q0[0] + mu[0] * q1[0] + w_y * q2[0]);
  const double g_w0 = q2[0] + at.z * g[kDet];
  double g_z = g[kZ] + w_0 * g[kDet];
  const double g_mu[2] = {q1[2] - at.b[2] * q2[2] + mv[1] * g_w0, -q0[2] + at.a[2] * q2[2] - mv[0] * g_w0};
  const double g_mv[2] = {-q1[1] + at.b[2] * q2[1] - mu[1] * g_w0, q0[1] - at.a[2] * q2[1] + mu[0] * g_w0};
  const double g_disc_x = g_cx - at.a[2] * g_mu[0] - at.b[2] * g_mu[1];
  const double g_disc_y = g_cy - at.a[2] * g_mv[0] - at.b[2] * g_mv[1];
  const double g_cx_all = g_disc_x + g[kCx], g_cy_all = g_disc_y + g[kCy];

  double g_a[3], g_b[3], g_p[3];  // gradients of a, b, p over p_z; then of a, b, p
  for (int i = 0; i < 3; ++i) {
    g_a[i] = view.kx[i] * g_mu[0] + view.ky[i] * g_mv[0];
    g_b[i] = view.kx[i] * g_mu[1] + view.ky[i] * g_mv[1];
    g_p[i] = view.kx[i] * g_cx_all + view.ky[i] * g_cy_all;
  }
  g_a[2] += -at.cx * g_mu[0] - at.cy * g_mv[0] - mv[1] * q2[1] + mu[1] * q2[2];
  g_b[2] += -at.cx * g_mu[1] - at.cy * g_mv[1] + mv[0] * q2[1] - mu[0] * q2[2];
  g_z -= (dot(g_a, at.a) + dot(g_b, at.b) + dot(g_p, at.p)) * at.inverse_z;
  for (int i = 0; i < 3; ++i) {
    g_a[i] *= at.inverse_z;
    g_b[i] *= at.inverse_z;
    g_p[i] *= at.inverse_z;
  }
  g_p[2] += g_z;

  ShapeGradients out;
  out.screen_shift[0] = g_disc_x * view.width / 2;
  out.screen_shift[1] = g_disc_y * view.height / 2;
  multiply_transposed(view.rotation, g_p, out.mean);
  const double g_normal[3] = {at.facing * g[kNormal], at.facing * g[kNormal + 1], at.facing * g[kNormal + 2]};
  double u[3], v[3], n[3];  // gradients of the columns of R
  multiply_transposed(view.rotation, g_a, u);
  multiply_transposed(view.rotation, g_b, v);
  multiply_transposed(view.rotation, g_normal, n);
  out.log_scale[0] = s.scale[0] * dot(u, at.axis_u);
  out.log_scale[1] = s.scale[1] * dot(v, at.axis_v);
  for (int i = 0; i < 3; ++i) {
    u[i] *= s.scale[0];
    v[i] *= s.scale[1];
  }
  const double w = at.unit[0], x = at.unit[1], y = at.unit[2], z = at.unit[3];
  const double g_unit[4] = {2 * (z * (u[1] - v[0]) + y * (n[0] - u[2]) + x * (v[2] - n[1])),
                            2 * (y * (u[1] + v[0]) + z * (u[2] + n[0]) + w * (v[2] - n[1]) - 2 * x * (v[1] + n[2])),
                            2 * (x * (u[1] + v[0]) + z * (v[2] + n[1]) + w * (n[0] - u[2]) - 2 * y * (u[0] + n[2])),
                            2 * (x * (u[2] + n[0]) + y * (v[2] + n[1]) + w * (u[1] - v[0]) - 2 * z * (u[0] + v[1]))};
  const double along = at.unit[0] * g_unit[0] + dot(at.unit + 1, g_unit + 1);
  for (int i = 0; i < 4; ++i) out.quat[i] = (g_unit[i] - at.unit[i] * along) * at.inverse_length;
  return out;
}

}  // namespace beags
