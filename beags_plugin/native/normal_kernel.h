// Normal consistency and its gradient, one row at a time (method, section 1). Included once for each instruction set.
#pragma once

#include "row_vectors.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

template <class T>
constexpr T kTiny = sizeof(T) == 4 ? T(1.17549435e-38) : T(2.2250738585072014e-308);  // smallest normal number

// Three vectors of numbers: one point or direction in each lane.
template <class R>
struct Triple {
  R x, y, z;
};
template <class R>
BEAGS_OPS_INLINE Triple<R> cross(Triple<R> a, Triple<R> b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class R>
BEAGS_OPS_INLINE R dot(Triple<R> a, Triple<R> b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class R>
BEAGS_OPS_INLINE Triple<R> times(R a, Triple<R> b) {
  return {a * b.x, a * b.y, a * b.z};
}
template <class R>
BEAGS_OPS_INLINE Triple<R> minus(Triple<R> a, Triple<R> b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}

// The point at depth 1 under the centres of pixels (x, y); x: one number in each lane.
template <class T>
BEAGS_OPS_INLINE Triple<RealOf<T>> ray(const NormalJob<T>& job, RealOf<T> x, int y) {
  const RealOf<T> zero = {};
  const T ray_y = (T(y) + T(0.5) - job.cy) * job.fy_inverse;
  return {(x + T(0.5) - job.cx - job.skew * ray_y) * job.fx_inverse, zero + ray_y, zero + T(1)};
}

// What the pixels from `at` = (x, y) on add to the error; leaves their gradients by the drawn normal, and by their four
// neighbours' depths in `shares`.
template <class T, class Where>
BEAGS_OPS_INLINE RealOf<T> normal_error(const NormalJob<T>& job, int64_t at, RealOf<T> x, int y, Where lanes) {
  using R = RealOf<T>;
  const R zero = {}, one = zero + T(1);
  const T* d = job.depth + at;
  const R center = lanes.load(d), right = lanes.load(d + 1), left = lanes.load(d - 1);
  const R lower = lanes.load(d + job.width), upper = lanes.load(d - job.width);
  auto known = (center > zero) & (right > zero) & (left > zero) & (lower > zero) & (upper > zero);
  // Divided by the depth, the product does not depend on the scene's scale; the direction stays the same.
  const R inverse = one / select(known, center, one);
  const auto to_right = ray(job, x + T(1), y), to_left = ray(job, x - T(1), y);
  const auto to_lower = ray(job, x, y + 1), to_upper = ray(job, x, y - 1);
  const auto across = times(inverse, minus(times(right, to_right), times(left, to_left)));
  const auto down = times(inverse, minus(times(lower, to_lower), times(upper, to_upper)));
  const auto product = cross(down, across);
  const R squared = dot(product, product);
  known &= squared > kTiny<T>;                                            // false for NaN
  const R turn = select(dot(product, ray(job, x, y)) > zero, -one, one);  // towards the camera
  const R length_inverse = turn / sqrt(select(known, squared, one));
  const auto slope = times(length_inverse, product);
  T numbers[3][Lanes<T>::kCount] = {};
  const int size = lanes.template size<T>();
  for (int lane = 0; lane < size; ++lane) {
    for (int c = 0; c < 3; ++c) numbers[c][lane] = job.normal[3 * (at + lane) + c];
  }
  const Triple<R> n = {Whole::load(numbers[0]), Whole::load(numbers[1]), Whole::load(numbers[2])};
  const R agreement = dot(n, slope), alpha = lanes.load(job.alpha + at);
  if (job.shares) {
    const R weight = select(known, job.scale * alpha, zero);
    const auto keep = [&](R value) { return select(known, value, zero); };
    // d(n . slope) by the unnormalised product is (n - slope (n . slope)) / length.
    const auto g = times(-weight * length_inverse, minus(n, times(agreement, slope)));
    const auto g_across = times(inverse, cross(g, down)), g_down = times(inverse, cross(across, g));
    const int64_t map = static_cast<int64_t>(job.height) * job.width;
    lanes.store(job.shares + at, keep(dot(g_across, to_right)));
    lanes.store(job.shares + map + at, keep(-dot(g_across, to_left)));
    lanes.store(job.shares + 2 * map + at, keep(dot(g_down, to_lower)));
    lanes.store(job.shares + 3 * map + at, keep(-dot(g_down, to_upper)));
    Whole::store(numbers[0], keep(-weight * slope.x));
    Whole::store(numbers[1], keep(-weight * slope.y));
    Whole::store(numbers[2], keep(-weight * slope.z));
    for (int lane = 0; lane < size; ++lane) {
      for (int c = 0; c < 3; ++c) job.g_normal[3 * (at + lane) + c] = numbers[c][lane];
    }
  }
  return select(known, alpha * (one - agreement), zero);
}

// At the image's border there is no error.
template <class T>
BEAGS_OPS_INLINE void normal_border(const NormalJob<T>& job, int64_t at) {
  if (!job.shares) return;
  const int64_t map = static_cast<int64_t>(job.height) * job.width;
  for (int i = 0; i < 4; ++i) job.shares[i * map + at] = T(0);
  for (int c = 0; c < 3; ++c) job.g_normal[3 * at + c] = T(0);
}

// Row `y` of the error.
template <class T>
void normal(const NormalJob<T>& job, int y) {
  using R = RealOf<T>;
  const int64_t start = static_cast<int64_t>(y) * job.width;
  R sum = {};  // Determinism: summed lane by lane along the row, whoever draws it
  if (y == 0 || y + 1 >= job.height || job.width < 3) {
    for (int x = 0; x < job.width; ++x) normal_border(job, start + x);
  } else {
    normal_border(job, start);
    normal_border(job, start + job.width - 1);
    R x = {};
    for (int lane = 0; lane < Lanes<T>::kCount; ++lane) x[lane] = static_cast<T>(1 + lane);
    for_each_vector<T>(job.width - 2, [&](int64_t i, auto lanes) {
      sum += normal_error(job, start + 1 + i, x + static_cast<T>(i), y, lanes);
    });
  }
  double total = 0;
  for (int lane = 0; lane < Lanes<T>::kCount; ++lane) total += sum[lane];
  job.sums[y] = total;
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
