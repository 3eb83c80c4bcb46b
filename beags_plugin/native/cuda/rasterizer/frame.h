// Declares the steps of a render on a GPU: one view of one set of Gaussians. The caller (torch) owns all memory, all
// work goes to its stream, and nothing here waits for the GPU.
#pragma once

#include "cuda/platform.h"
#include "rasterizer/gaussian_inputs.h"
#include "rasterizer/types.h"

namespace beags {
namespace cuda {

constexpr int kMaskBits = 16;
constexpr int kMostTiles = 0xFFFF;  // a pair's key holds the tile above the mask of Pair (types.h)

// Gaussians, projected and sorted into tiles.
template <class T>
struct Bins {
  Splat<T>* splats;        // [N]
  int32_t* counts;         // [N] number of tiles that a Gaussian reaches
  int32_t* order;          // [N] Gaussians by depth, then by index; those that reach no tile come last
  int64_t* pair_start;     // [N + 1] the pairs of order[r] are pair_start[r] .. pair_start[r + 1] - 1
  int64_t* totals;         // [2] pairs; Gaussians with numbers that are not finite
  int64_t capacity;        // number of pairs that the memory holds; with more pairs, the images are wrong
  int32_t* pair_gaussian;  // [capacity]
  uint32_t* keys;          // [capacity] tile << kMaskBits | mask, ordered by tile, then by depth
  int32_t* pairs;          // [capacity] in the order of `keys`
  int32_t* tile_start;     // [tiles + 1] into keys and pairs
};

// Device memory that is free again when the kernels end.
struct Scratch {
  void* temporary;  // see primitives.h
  size_t temporary_bytes;
  uint32_t* keys[3];  // project: [N] each, the last one for float64 only; bin: [capacity], the first one only
  int32_t* values;    // the size of one of `keys`
};

// Projects the Gaussians; fills the part of `bins` that does not depend on the capacity. visible: [N], whether a
// Gaussian is rendered and its box touches the image.
template <class T>
void project_gaussians(const View& view, const Inputs<T>& inputs, const Bins<T>& bins, bool* visible,
                       const Scratch& scratch, Stream stream);
// Fills the rest of `bins`.
template <class T>
void bin_gaussians(const View& view, int64_t count, const Bins<T>& bins, const Scratch& scratch, Stream stream);

// The forward's results for the backward: [height, width] each; null: not rendered, or no backward.
template <class T>
struct Kept {
  T* end_transmittance;
  int32_t* end;  // pairs of the tile before the one at which the pixel stopped
  T* depth_sum;
  int32_t* median_pair;          // the pair at which T passes 0.5, or -1
  T *first, *moment1, *moment2;  // see Saved
};

// Everything that the kernels of the tiles read and write.
template <class T>
struct TileJob {
  int width, height, tiles_x, tiles_y;
  T near_plane, mapping;  // see Job
  const T* background;    // [3]
  const int32_t* target;  // [height, width] class ids, or null: no boundary
  Bins<T> bins;
  Images<T> images;
  Kept<T> kept;
  Images<const T> gradients;
  T* records;       // [pairs, record_size(parts)]
  T* g_background;  // [tiles, 3]
};

template <class T>
void draw_forward(const TileJob<T>& job, Stream stream);
// parts: those of the images that have a gradient.
template <class T>
void draw_backward(const TileJob<T>& job, Parts parts, Stream stream);

// Returns how many numbers a record has in a backward of these parts.
template <class T>
int backward_record(Parts parts);

// Null: not wanted; the others are filled. sums: [N, kRecord] float64.
template <class T>
struct GaussianGradients {
  T *means, *quats, *log_scales, *opacity_logits, *colors, *screen_shift;
  double* sums;
};
template <class T>
void reduce_records(const View& view, const Inputs<T>& inputs, const Bins<T>& bins, const T* records, int size,
                    const GaussianGradients<T>& to, Stream stream);

// The unit of a weight w as a whole number: sums then do not depend on their order.
constexpr int kWeightBits = 38;

// labels: [height, width]; sums: [N, num_classes] in units of 2^-kWeightBits, zero on entry (E6).
template <class T>
void class_contributions(const TileJob<T>& job, const int32_t* labels, int num_classes, int64_t* sums, Stream stream);
// classes, share: [height, width]. Class ids lie in 0 .. num_classes - 1, num_classes <= kIgnore.
template <class T>
void class_map(const TileJob<T>& job, int num_classes, int32_t* classes, T* share, Stream stream);
// indices: [height, width].
template <class T>
void dominant_gaussian(const TileJob<T>& job, int32_t* indices, Stream stream);

}  // namespace cuda
}  // namespace beags
