// Computes one pixel's part of normal consistency, and its gradients (method, section 1), for the vectors of CPUs and
// the threads of GPUs. R: T, or a vector of T.
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

template <class T>
constexpr T kTiny = sizeof(T) == 4 ? T(1.17549435e-38) : T(2.2250738585072014e-308);  // smallest normal number

// A point or direction; or one in each lane.
template <class R>
struct Triple {
  R x, y, z;
};
template <class R>
BEAGS_HD_INLINE Triple<R> cross(Triple<R> a, Triple<R> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class R>
BEAGS_HD_INLINE R dot(Triple<R> a, Triple<R> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class R>
BEAGS_HD_INLINE Triple<R> times(R a, Triple<R> b) {
  return {a * b.x, a * b.y, a * b.z};
}
template <class R>
BEAGS_HD_INLINE Triple<R> minus(Triple<R> a, Triple<R> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

// Returns the point at depth 1 under the centre of a pixel (x, y).
template <class T, class R>
BEAGS_HD_INLINE Triple<R> ray(const NormalJob<T>& job, R x, int y) {
  const R zero = {};
  const T ray_y = (T(y) + T(0.5) - job.cy) * job.fy_inverse;
  return {(x + T(0.5) - job.cx - job.skew * ray_y) * job.fx_inverse, zero + ray_y, zero + T(1)};
}

// Depths at a pixel and at its neighbours, 0 where unknown.
template <class R>
struct Depths {
  R center, right, left, lower, upper;
};

// The error and its gradients, times job.scale: of the depth of the right, left, lower and upper neighbour (that of the
// pixel's own depth is 0), and of the rendered normal.
template <class R>
struct NormalTerms {
  R error, shares[4];
  Triple<R> g_normal;
};

// Computes the terms of a pixel (x, y) with the rendered normal n.
template <class T, class R>
BEAGS_HD_INLINE NormalTerms<R> normal_terms(const NormalJob<T>& job, R x, int y, const Depths<R>& d, Triple<R> n,
                                            R alpha) {
  const R zero = {}, one = zero + T(1);
  auto known = (d.center > zero) & (d.right > zero) & (d.left > zero) & (d.lower > zero) & (d.upper > zero);
  // Dividing by the depth frees the product from the scene's scale; the direction stays the same.
  const R inverse = one / select(known, d.center, one);
  const auto to_right = ray(job, x + T(1), y), to_left = ray(job, x - T(1), y);
  const auto to_lower = ray(job, x, y + 1), to_upper = ray(job, x, y - 1);
  const auto across = times(inverse, minus(times(d.right, to_right), times(d.left, to_left)));
  const auto down = times(inverse, minus(times(d.lower, to_lower), times(d.upper, to_upper)));
  const auto product = cross(down, across);
  const R squared = dot(product, product);
  known &= squared > kTiny<T>;                                            // The comparison is false for NaN.
  const R turn = select(dot(product, ray(job, x, y)) > zero, -one, one);  // The normal shall face the camera.
  const R length_inverse = turn / sqrt(select(known, squared, one));
  const auto slope = times(length_inverse, product);
  const R agreement = dot(n, slope), weight = select(known, job.scale * alpha, zero);
  // The gradient of n . slope in the unnormalised product is (n - slope (n . slope)) / length.
  const auto g = times(-weight * length_inverse, minus(n, times(agreement, slope)));
  const auto g_across = times(inverse, cross(g, down)), g_down = times(inverse, cross(across, g));
  return {select(known, alpha * (one - agreement), zero),
          {select(known, dot(g_across, to_right), zero), select(known, -dot(g_across, to_left), zero),
           select(known, dot(g_down, to_lower), zero), select(known, -dot(g_down, to_upper), zero)},
          {select(known, -weight * slope.x, zero), select(known, -weight * slope.y, zero),
           select(known, -weight * slope.z, zero)}};
}

// Returns the gradient of the depth of pixel number `at`. Determinism: it is gathered from the neighbours, in a fixed
// order.
template <class T>
BEAGS_HD_INLINE T gathered_shares(const NormalJob<T>& job, int64_t at) {
  const int64_t line = job.width, map = static_cast<int64_t>(job.height) * line, x = at % line, y = at / line;
  T sum = 0;
  if (x > 0) sum += job.shares[at - 1];
  if (x + 1 < job.width) sum += job.shares[map + at + 1];
  if (y > 0) sum += job.shares[2 * map + at - line];
  if (y + 1 < job.height) sum += job.shares[3 * map + at + line];
  return sum;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
