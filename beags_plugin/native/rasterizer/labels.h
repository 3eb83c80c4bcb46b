// Holds the labels of a tile's pixels (E7). Included once for each instruction set.
#pragma once

#include "rasterizer/composite.h"

namespace beags {
namespace BEAGS_ISA {

// The labels of one pack of pixels.
template <class T>
struct Labels {
  T target[kLanes<T>];
  int32_t only;  // the class of all its labelled pixels, kIgnore without any, kMixed with several

  static constexpr int32_t kMixed = -1;

  // Returns whether a Gaussian of that class is right at every labelled pixel: it then adds nothing, as most do.
  BEAGS_INLINE bool all_right(int32_t class_id) const { return only == class_id; }
  BEAGS_INLINE Mask<T> right(int32_t class_id) const { return load(target) == all(static_cast<T>(class_id)); }
  BEAGS_INLINE Mask<T> ignored() const { return load(target) == all(static_cast<T>(kIgnore)); }
};

// Returns the label of all pixels of a tile, which most tiles have; kMixed with several.
template <class T>
BEAGS_INLINE int32_t label_everywhere(const Job<T>& job, int tile) {
  const int x0 = tile % job.tiles_x * kTile, y0 = tile / job.tiles_x * kTile;
  const int columns = job.width - x0 < kTile ? job.width - x0 : kTile;
  const int rows = job.height - y0 < kTile ? job.height - y0 : kTile;
  const int32_t* row = job.target + static_cast<int64_t>(y0) * job.width + x0;
  const int32_t first = *row;
  int32_t different = 0;
  for (int y = 0; y < rows; ++y, row += job.width) {
    for (int x = 0; x < columns; ++x) different |= row[x] ^ first;
  }
  return different ? Labels<T>::kMixed : first;
}

// Fills the `labels` of each pack. Returns the tile's label, kMixed with several.
template <class T, class Pixels>
BEAGS_INLINE int32_t load_labels(const Job<T>& job, int tile, Pixels* pixels) {
  const int32_t everywhere = label_everywhere(job, tile),
                filled = everywhere == Labels<T>::kMixed ? kIgnore : everywhere;
  for (int pack = 0; pack < kTilePacks<T>; ++pack) {
    pixels[pack].labels.only = filled;
    store(pixels[pack].labels.target, all(static_cast<T>(filled)));
  }
  if (everywhere != Labels<T>::kMixed) return everywhere;
  for_each_pixel(job, tile, [&](int64_t at, int pack, int lane) {
    Labels<T>& labels = pixels[pack].labels;
    const int32_t label = job.target[at];
    labels.target[lane] = static_cast<T>(label);
    if (label == kIgnore) return;
    labels.only = labels.only == kIgnore || labels.only == label ? label : Labels<T>::kMixed;
  });
  return everywhere;
}

}  // namespace BEAGS_ISA
}  // namespace beags
