// The image losses' kernels: each works on one row of pixels, on raw pointers, and no row depends on how the rows are
// shared among threads. Compiled once for each instruction set (image_baseline.cpp, image_avx2.cpp).
#pragma once

#include <stdint.h>

#include <cmath>

namespace beags {
namespace ops {

constexpr int kSsimWindow = 11, kSsimReach = kSsimWindow / 2;  // of SSIM, pixels
constexpr int kChannels = 3;

// L1 and SSIM of an image against a reference; see ops/photometric.py. Images are [H, W, 3], row-major.
template <class T>
struct PhotometricJob {
  int width, height;
  const T *image, *reference;
  T window[kSsimWindow];
  T c1, c2;                // the constants of SSIM
  T l1_scale, ssim_scale;  // of the gradient: of sum |x - y| and of the sum of the index
  T* slopes;               // [3, H, W, 3] by blurred x, blurred x^2 + y^2, blurred x y; null: no gradient wanted
  T* gradient;             // [H, W, 3]
  double* sums;            // [H, 2] sum of |x - y| and of the index, by row
};

// The window: Gaussian, sigma 1.5 pixels, of sum 1.
template <class T>
void set_window(PhotometricJob<T>& job) {
  double window[kSsimWindow], total = 0;
  for (int k = 0; k < kSsimWindow; ++k)
    total += window[k] = std::exp(-0.5 * (k - kSsimReach) * (k - kSsimReach) / (1.5 * 1.5));
  for (int k = 0; k < kSsimWindow; ++k) job.window[k] = static_cast<T>(window[k] / total);
}

// Normal consistency of a drawn view; see ops/normal_consistency.py. Images are [H, W] or [H, W, 3].
template <class T>
struct NormalJob {
  int width, height;
  T fx_inverse, fy_inverse, skew, cx, cy;
  const T *depth, *normal, *alpha;
  T scale;    // of the gradients
  T* shares;  // [4, H, W] gradient by the depth of the right, left, lower and upper neighbour; null: no gradient
  T *g_depth, *g_normal;
  double* sums;  // [H] sum of A (1 - n . n_depth), by row
};

template <class T>
struct ImageKernels {
  void (*photometric)(const PhotometricJob<T>& job, int row, T* scratch);
  void (*photometric_gradient)(const PhotometricJob<T>& job, int row, T* scratch);
  int64_t (*photometric_scratch)(int width);
  void (*normal)(const NormalJob<T>& job, int row);
  void (*normal_gradient)(const NormalJob<T>& job, int row);
};

}  // namespace ops
}  // namespace beags
