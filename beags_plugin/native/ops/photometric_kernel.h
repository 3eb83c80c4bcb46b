// Computes L1 and SSIM, and their gradient in closed form, one row at a time (method, section 1). Included once for
// each instruction set. A row is blurred down the columns first (its products are computed again for each row) into a
// few buffers that stay in the cache, then along the row, where the window steps over the interleaved channels.
#pragma once

#include "ops/lanes.h"
#include "ops/photometric_terms.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

constexpr int kPad = kSsimReach * kChannels;  // numbers beyond a row's ends that the window reaches; they are 0

// Returns how many numbers one buffer of a row has.
template <class T>
BEAGS_INLINE int64_t buffer_length(int width) {
  return static_cast<int64_t>(width) * kChannels + 2 * kPad + 2 * Lanes<T>::kCount;
}
template <class T>
int64_t photometric_scratch(int width) {
  return 4 * buffer_length<T>(width);
}

template <class T>
BEAGS_INLINE void clear_pads(T* scratch, int width, int buffers) {
  const int64_t length = buffer_length<T>(width), end = kPad + static_cast<int64_t>(width) * kChannels;
  for (int b = 0; b < buffers; ++b) {
    for (int i = 0; i < kPad; ++i) scratch[b * length + i] = T(0);
    for (int64_t i = end; i < length; ++i) scratch[b * length + i] = T(0);
  }
}

// Blurs along a row. `from` points at the buffer's number of the first lane.
template <class T>
BEAGS_INLINE RealOf<T> blur_row(const PhotometricJob<T>& job, const T* from) {
  RealOf<T> sum = {};
  for (int k = 0; k < kSsimWindow; ++k) {
    RealOf<T> value;
    __builtin_memcpy(&value, from + (k - kSsimReach) * kChannels, sizeof value);
    sum = fma(RealOf<T>{} + job.window[k], value, sum);
  }
  return sum;
}

template <class T>
void photometric(const PhotometricJob<T>& job, int row, T* scratch) {
  using R = RealOf<T>;
  const int64_t line = static_cast<int64_t>(job.width) * kChannels, length = buffer_length<T>(job.width);
  const int first = row < kSsimReach ? -row : -kSsimReach;
  const int last = row + kSsimReach < job.height ? kSsimReach : job.height - 1 - row;
  clear_pads(scratch, job.width, 4);
  for_each_vector<T>(line, [&](int64_t i, auto lanes) {
    R x = {}, y = {}, squares = {}, product = {};
    for (int k = first; k <= last; ++k) {
      const int64_t at = (row + k) * line + i;
      const R w = R{} + job.window[k + kSsimReach];
      const R a = lanes.load(job.image + at), b = lanes.load(job.reference + at);
      const R wa = w * a, wb = w * b;
      x += wa;
      y += wb;
      squares = fma(wa, a, fma(wb, b, squares));
      product = fma(wa, b, product);
    }
    T* to = scratch + kPad + i;
    lanes.store(to, x);
    lanes.store(to + length, y);
    lanes.store(to + 2 * length, squares);
    lanes.store(to + 3 * length, product);
  });
  const int64_t map = static_cast<int64_t>(job.height) * line;
  R absolute = {}, similar = {};  // Determinism: summed lane by lane along the row, on any thread
  for_each_vector<T>(line, [&](int64_t i, auto lanes) {
    const T* from = scratch + kPad + i;
    const R m_x = blur_row(job, from), m_y = blur_row(job, from + length);
    const R squares = blur_row(job, from + 2 * length), product = blur_row(job, from + 3 * length);
    const SsimTerms<R> terms = ssim_terms(m_x, m_y, squares, product, job.c1, job.c2);
    const int64_t at = row * line + i;
    const R difference = lanes.load(job.image + at) - lanes.load(job.reference + at);
    absolute += select(difference < R{}, -difference, difference);
    T counted[Lanes<T>::kCount] = {};
    lanes.store(counted, terms.index);
    similar += Whole::load(counted);
    if (job.slopes) {
      lanes.store(job.slopes + at, terms.by_mean);
      lanes.store(job.slopes + map + at, terms.by_squares);
      lanes.store(job.slopes + 2 * map + at, terms.by_product);
    }
  });
  double sums[2] = {};
  for (int lane = 0; lane < Lanes<T>::kCount; ++lane) {
    sums[0] += absolute[lane];
    sums[1] += similar[lane];
  }
  job.sums[2 * row] = sums[0];
  job.sums[2 * row + 1] = sums[1];
}

// Computes a row of the gradient. A symmetric window with zeros outside is its own adjoint, so the backward is the same
// blur.
template <class T>
void photometric_gradient(const PhotometricJob<T>& job, int row, T* scratch) {
  using R = RealOf<T>;
  const int64_t line = static_cast<int64_t>(job.width) * kChannels, length = buffer_length<T>(job.width);
  const int64_t map = static_cast<int64_t>(job.height) * line;
  const int first = row < kSsimReach ? -row : -kSsimReach;
  const int last = row + kSsimReach < job.height ? kSsimReach : job.height - 1 - row;
  clear_pads(scratch, job.width, 3);
  for_each_vector<T>(line, [&](int64_t i, auto lanes) {
    R sums[3] = {};
    for (int k = first; k <= last; ++k) {
      const T* from = job.slopes + (row + k) * line + i;
      const R w = R{} + job.window[k + kSsimReach];
      for (int m = 0; m < 3; ++m) sums[m] = fma(w, lanes.load(from + m * map), sums[m]);
    }
    for (int m = 0; m < 3; ++m) lanes.store(scratch + m * length + kPad + i, sums[m]);
  });
  for_each_vector<T>(line, [&](int64_t i, auto lanes) {
    const T* from = scratch + kPad + i;
    const R mean = blur_row(job, from), squares = blur_row(job, from + length);
    const R product = blur_row(job, from + 2 * length);
    const int64_t at = row * line + i;
    const R x = lanes.load(job.image + at), y = lanes.load(job.reference + at);
    const R one = R{} + T(1);
    const R sign = select(x > y, one, select(x < y, -one, R{}));
    const R similar = mean + T(2) * x * squares + y * product;
    lanes.store(job.gradient + at, job.l1_scale * sign + job.ssim_scale * similar);
  });
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
