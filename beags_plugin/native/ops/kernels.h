// Declares the ops' kernels and their jobs. A kernel works on one share of the data (a block of Gaussians, a row of
// pixels), on one thread, on raw pointers. build_baseline.cpp and build_avx2.cpp compile all of them, once each; the
// files that split the work among threads ask `best_table`.
#pragma once

#include <stdint.h>

#include <cmath>

namespace beags {
namespace ops {

struct VoxelTable;

// The inputs and outputs of the occupancy loss (E9); see ops/occupancy_loss.py.
template <class T>
struct OccupancyJob {
  const T *means, *quats, *log_scales, *opacity_logits;  // [N, 3], [N, 4], [N, 2], [N]
  const int32_t* class_ids;                              // [N]
  const VoxelTable* valid;  // [kLargestCube]: corners of cubes of 1, 2 and 3 valid voxels along each side
  T origin[3], voxel_size;
  uint64_t stream;  // hash of seed and step
  bool skip;        // skip discs that wholly lie in valid voxels; false: to measure what that saves
  int64_t samples;
  bool background;
  double factor;                                           // 1 / (N Z)
  T *g_means, *g_quats, *g_log_scales, *g_opacity_logits;  // null: no gradients
};

constexpr int kOccupancyBlock = 512;  // Gaussians of one call

// Colours from spherical harmonics; see ops/sh_colors.py.
template <class T>
struct ColorJob {
  int degree, num_rest;  // num_rest: coefficients of `rest`, at least (degree + 1)^2 - 1
  T center[3];
  const T *dc, *rest, *means;  // [N, 3], [N, num_rest, 3], [N, 3]
  T* colors;                   // [N, 3]
  uint8_t* clamped;            // [N] bit c: channel c was below 0
  const T* g_colors;
  T *g_dc, *g_rest, *g_means;  // null: not wanted
};

constexpr int kColorBlock = 64;  // Gaussians of one call

// One row of pixels of one view, projected into another; see ops/reprojection_votes.py.
template <class T>
struct CastJob {
  T a[9], b[3];  // a source pixel (x, y) at depth d projects to d A (x, y, 1) + b = z (x', y', 1)
  int source_width, target_width, target_height;
  const T* target_depth;  // null: every vote counts
  T tau;
  int num_classes;
  uint32_t* votes;  // [target_height, target_width, num_classes]
};

constexpr int kSsimWindow = 11, kSsimReach = kSsimWindow / 2;  // window of SSIM, pixels
constexpr int kChannels = 3;

// L1 and SSIM of an image against a reference; see ops/photometric.py. Images are [H, W, 3], row-major.
template <class T>
struct PhotometricJob {
  int width, height;
  const T *image, *reference;
  T window[kSsimWindow];
  T c1, c2;                // the constants of SSIM
  T l1_scale, ssim_scale;  // factors of the gradients of sum |x - y| and of the sum of the index
  T* slopes;               // [3, H, W, 3] slopes of blurred x, blurred x^2 + y^2, blurred x y; null: no gradient wanted
  T* gradient;             // [H, W, 3]
  double* sums;            // [H, 2] sum of |x - y| and of the index, by row
};

// Sets the window: a Gaussian of sigma 1.5 pixels and sum 1.
template <class T>
void set_window(PhotometricJob<T>& job) {
  double window[kSsimWindow], total = 0;
  for (int k = 0; k < kSsimWindow; ++k)
    total += window[k] = std::exp(-0.5 * (k - kSsimReach) * (k - kSsimReach) / (1.5 * 1.5));
  for (int k = 0; k < kSsimWindow; ++k) job.window[k] = static_cast<T>(window[k] / total);
}

// Normal consistency of a rendered view; see ops/normal_consistency.py. Images are [H, W] or [H, W, 3].
template <class T>
struct NormalJob {
  int width, height;
  T fx_inverse, fy_inverse, skew, cx, cy;
  const T *depth, *normal, *alpha;
  T scale;    // factor of the gradients
  T* shares;  // [4, H, W] gradients of the depth of the right, left, lower and upper neighbour; null: no gradient
  T *g_depth, *g_normal;
  double* sums;  // [H] sum of A (1 - n . n_depth), by row
};

template <class T>
struct OpKernels {
  // Gaussians first .. last - 1, at most kOccupancyBlock. Returns the sum of their losses, times `factor`; adds the
  // number of sampled Gaussians to `active`.
  double (*occupancy)(const OccupancyJob<T>& job, int64_t first, int64_t last, int64_t* active);
  // Gaussians first .. last - 1, at most kColorBlock.
  void (*colors)(const ColorJob<T>& job, int64_t first, int64_t last);
  void (*colors_backward)(const ColorJob<T>& job, int64_t first, int64_t last);
  // Row y of the source: depth and labels [source_width].
  void (*cast_row)(const CastJob<T>& job, int y, const T* depth, const int32_t* labels);
  // One row of pixels; scratch: photometric_scratch(width) numbers.
  void (*photometric)(const PhotometricJob<T>& job, int row, T* scratch);
  void (*photometric_gradient)(const PhotometricJob<T>& job, int row, T* scratch);
  int64_t (*photometric_scratch)(int width);
  // One row of pixels.
  void (*normal)(const NormalJob<T>& job, int row);
  void (*normal_gradient)(const NormalJob<T>& job, int row);
};

constexpr int64_t kTeamPixels = 16384;  // A team costs tens of microseconds, a pixel some ten nanoseconds.

// Returns how many threads share an image.
inline int image_team(int width, int height, int threads) {
  return static_cast<int64_t>(width) * height < kTeamPixels ? 1 : threads;
}

}  // namespace ops
}  // namespace beags
