// Computes a Gaussian's disc in voxels, and turns the sums over its samples into gradients (method, section 6; E9), for
// the vectors of CPUs and the threads of GPUs. R: T, or a vector of T.
#pragma once

#include "ops/kernels.h"
#include "simd/device.h"
#if defined(__CUDACC__) || defined(BEAGS_CUDA_EMULATION)
#include "simd/scalar_math.h"
#else
#include "ops/lanes.h"
#endif

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class R>
struct DiscFrame {
  R unit[4], inverse_length;          // the quaternion q / |q|, 1 / |q|
  R r0[3], r1[3];                     // columns of the rotation
  R scale[2];                         // world units
  R center[3], axis_u[3], axis_v[3];  // voxels; s R0 and s R1
};

// Fills a frame whose `scale` is known. mean, quat: [3], [4].
template <class T, class R>
BEAGS_HD_INLINE void fill_frame(const OccupancyJob<T>& job, const R* mean, const R* quat, DiscFrame<R>& f) {
  const R zero = {}, one = zero + T(1), two = zero + T(2);
  const R* q = quat;
  f.inverse_length = one / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int part = 0; part < 4; ++part) f.unit[part] = q[part] * f.inverse_length;
  const R w = f.unit[0], x = f.unit[1], y = f.unit[2], z = f.unit[3];
  f.r0[0] = one - two * (y * y + z * z);
  f.r0[1] = two * (x * y + w * z);
  f.r0[2] = two * (x * z - w * y);
  f.r1[0] = two * (x * y - w * z);
  f.r1[1] = one - two * (x * x + z * z);
  f.r1[2] = two * (y * z + w * x);
  const T per_voxel = T(1) / job.voxel_size;
  for (int axis = 0; axis < 3; ++axis) {
    f.axis_u[axis] = f.scale[0] * f.r0[axis] * per_voxel;
    f.axis_v[axis] = f.scale[1] * f.r1[axis] * per_voxel;
    f.center[axis] = (mean[axis] - job.origin[axis]) * per_voxel;
  }
}

// Returns how far the disc reaches along an axis, in voxels, with a margin of a few units in the last place: the
// samples are rounded differently. distance: |center|.
template <class T, class R>
BEAGS_HD_INLINE R reach_along(R u, R v, R distance) {
  constexpr T kEpsilon = sizeof(T) == 4 ? T(1.1920929e-7) : T(2.220446049250313e-16);
  return T(3) * sqrt(u * u + v * v) * (1 + 16 * kEpsilon) + 16 * kEpsilon * distance;
}

// Adds a sample outside the valid voxels to the six sums of G Q times 1, u, v, u^2, v^2, u v. weight: G Q, or 0.
template <class R>
BEAGS_HD_INLINE void add_sample(R weight, R u, R v, R* sums) {
  const R wu = weight * u, wv = weight * v;
  sums[0] += weight;
  sums[1] += wu;
  sums[2] += wv;
  sums[3] = fma(wu, u, sums[3]);
  sums[4] = fma(wv, v, sums[4]);
  sums[5] = fma(wu, v, sums[5]);
}

// Computes the gradients of mean [3], quaternion [4], log scales [2] and opacity logit, in that order. sums: those of
// G Q times 1, u, v, u^2, v^2, u v.
template <class T, class R>
BEAGS_HD_INLINE void disc_gradients(const OccupancyJob<T>& job, const DiscFrame<R>& f, R opacity, const R* sums,
                                    R* out) {
  const R g = sums[0], gu = sums[1], gv = sums[2], guu = sums[3], gvv = sums[4], guv = sums[5];
  const R s_u = f.scale[0], s_v = f.scale[1];
  const R o = opacity * static_cast<T>(job.factor);
  const R along_u = o * gu / s_u, along_v = o * gv / s_v;
  for (int axis = 0; axis < 3; ++axis) {  // dG/dp = G (u / s_u R0 + v / s_v R1)
    out[axis] = along_u * f.r0[axis] + along_v * f.r1[axis];
  }
  // With dG/dR0 = -G u (x - p) / s_u, dG/dR1 = -G v (x - p) / s_v and x - p = u s_u R0 + v s_v R1, the torque
  // R0 x dG/dR0 + R1 x dG/dR1 is t n, t = G u v (s_u / s_v - s_v / s_u): only a turn within the plane changes G.
  // A turn by w moves the unit quaternion q by (0, w) q / 2, hence dG/dq = 2 t (0, n) q = 2 t q (0, 0, 0, 1).
  const R turn = T(2) * o * guv * (s_u / s_v - s_v / s_u) * f.inverse_length;
  out[3] = -turn * f.unit[3];
  out[4] = turn * f.unit[2];
  out[5] = -turn * f.unit[1];
  out[6] = turn * f.unit[0];
  out[7] = o * guu;  // dG/ds_u = G u^2 / s_u, so dG/d(log s_u) = G u^2
  out[8] = o * gvv;
  out[9] = o * (T(1) - opacity) * g;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
