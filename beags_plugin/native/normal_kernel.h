// Normal consistency and its gradient, one row at a time (method, section 1). Included once for each instruction set.
#pragma once

#include "image_kernels.h"
#include "lanes.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
constexpr T kTiny = sizeof(T) == 4 ? T(1.17549435e-38) : T(2.2250738585072014e-308);  // smallest normal number
BEAGS_OPS_INLINE float root(float x) { return sqrtf(x); }
BEAGS_OPS_INLINE double root(double x) { return ::sqrt(x); }

template <class T>
struct Vector {
  T x, y, z;
};
template <class T>
BEAGS_OPS_INLINE Vector<T> cross(Vector<T> a, Vector<T> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class T>
BEAGS_OPS_INLINE T dot(Vector<T> a, Vector<T> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class T>
BEAGS_OPS_INLINE Vector<T> times(T a, Vector<T> b) {
  return {a * b.x, a * b.y, a * b.z};
}
template <class T>
BEAGS_OPS_INLINE Vector<T> minus(Vector<T> a, Vector<T> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

// The point at depth 1 under a pixel's centre.
template <class T>
BEAGS_OPS_INLINE Vector<T> ray(const NormalJob<T>& job, int x, int y) {
  const T ray_y = (T(y) + T(0.5) - job.cy) * job.fy_inverse;
  return {(T(x) + T(0.5) - job.cx - job.skew * ray_y) * job.fx_inverse, ray_y, T(1)};
}

// Row `y` of the error; leaves what each pixel sends to its four neighbours' depths in `shares`.
template <class T>
void normal(const NormalJob<T>& job, int y) {
  const int64_t line = job.width, map = static_cast<int64_t>(job.height) * line;
  double sum = 0;
  const bool inner_row = y > 0 && y + 1 < job.height;
  for (int x = 0; x < job.width; ++x) {
    const int64_t at = y * line + x;
    T share[4] = {};
    Vector<T> g_normal = {};
    if (inner_row && x > 0 && x + 1 < job.width) {
      const T *d = job.depth + at, right = d[1], left = d[-1], lower = d[line], upper = d[-line];
      const bool seen = d[0] > 0 && right > 0 && left > 0 && lower > 0 && upper > 0;
      // Divided by the depth, the product does not depend on the scene's scale; the direction stays the same.
      const T inverse = T(1) / (seen ? d[0] : T(1));
      const Vector<T> to_right = ray(job, x + 1, y), to_left = ray(job, x - 1, y);
      const Vector<T> to_lower = ray(job, x, y + 1), to_upper = ray(job, x, y - 1);
      const Vector<T> across = times(inverse, minus(times(right, to_right), times(left, to_left)));
      const Vector<T> down = times(inverse, minus(times(lower, to_lower), times(upper, to_upper)));
      const Vector<T> product = cross(down, across);
      const T squared = dot(product, product);
      if (seen && squared > kTiny<T>) {
        const T turn = dot(product, ray(job, x, y)) > 0 ? T(-1) : T(1);  // towards the camera
        const T length_inverse = turn / root(squared);
        const Vector<T> slope = times(length_inverse, product);
        const T* drawn = job.normal + 3 * at;
        const Vector<T> n = {drawn[0], drawn[1], drawn[2]};
        const T agreement = dot(n, slope), weight = job.scale * job.alpha[at];
        sum += job.alpha[at] * (T(1) - agreement);
        g_normal = times(-weight, slope);
        // d(n . slope) by the unnormalised product is (n - slope (n . slope)) / length.
        const Vector<T> g = times(-weight * length_inverse, minus(n, times(agreement, slope)));
        const Vector<T> g_across = times(inverse, cross(g, down)), g_down = times(inverse, cross(across, g));
        share[0] = dot(g_across, to_right);
        share[1] = -dot(g_across, to_left);
        share[2] = dot(g_down, to_lower);
        share[3] = -dot(g_down, to_upper);
      }
    }
    if (job.shares) {
      for (int i = 0; i < 4; ++i) job.shares[i * map + at] = share[i];
      job.g_normal[3 * at] = g_normal.x;
      job.g_normal[3 * at + 1] = g_normal.y;
      job.g_normal[3 * at + 2] = g_normal.z;
    }
  }
  job.sums[y] = sum;
}

// Row `y` of the gradient by depth. Determinism: each pixel gathers from its neighbours, in a fixed order.
template <class T>
void normal_gradient(const NormalJob<T>& job, int y) {
  const int64_t line = job.width, map = static_cast<int64_t>(job.height) * line;
  for (int x = 0; x < job.width; ++x) {
    const int64_t at = y * line + x;
    T sum = 0;
    if (x > 0) sum += job.shares[at - 1];
    if (x + 1 < job.width) sum += job.shares[map + at + 1];
    if (y > 0) sum += job.shares[2 * map + at - line];
    if (y + 1 < job.height) sum += job.shares[3 * map + at + line];
    job.g_depth[at] = sum;
  }
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
