// The ops' kernels: each works on one share of the data, on one thread, on raw pointers. They are compiled once for
// each instruction set (ops_baseline.cpp, ops_avx2.cpp); the files that split the work among threads ask
// `best_table`.
#pragma once

#include <stdint.h>

namespace beags {
namespace ops {

struct VoxelTable;

// What the occupancy loss (E9) is made of; see ops/occupancy_loss.py.
template <class T>
struct OccupancyJob {
  const T *means, *quats, *log_scales, *opacity_logits;  // [N, 3], [N, 4], [N, 2], [N]
  const int32_t* class_ids;                              // [N]
  const VoxelTable* valid;  // [kLargestCube]: corners of cubes of 1, 2 and 3 valid voxels along each side
  T origin[3], voxel_size;
  uint64_t stream;  // hash of seed and step
  bool skip;        // pass over discs that wholly lie in valid voxels; false: to see what that saves
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

constexpr int kColorBlock = 64;  // surfels of one call

// One row of pixels of one view, cast into another; see ops/reprojection_votes.py.
template <class T>
struct CastJob {
  T a[9], b[3];  // a source pixel (x, y) at depth d projects to d A (x, y, 1) + b = z (x', y', 1)
  int source_width, target_width, target_height;
  const T* target_depth;  // null: every vote counts
  T tau;
  int num_classes;
  uint32_t* votes;  // [target_height, target_width, num_classes]
};

template <class T>
struct OpKernels {
  // Gaussians first .. last - 1, at most kOccupancyBlock. Returns the sum of their losses, times `factor`; adds the
  // number of those that had to be sampled to `active`.
  double (*occupancy)(const OccupancyJob<T>& job, int64_t first, int64_t last, int64_t* active);
  // Surfels first .. last - 1, at most kColorBlock.
  void (*colors)(const ColorJob<T>& job, int64_t first, int64_t last);
  void (*colors_backward)(const ColorJob<T>& job, int64_t first, int64_t last);
  // Row y of the source: depth and labels [source_width].
  void (*cast_row)(const CastJob<T>& job, int y, const T* depth, const int32_t* labels);
};

}  // namespace ops
}  // namespace beags
