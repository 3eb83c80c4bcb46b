// One surfel into one view, and the way back for its gradient. Everything here is float64: it costs little beside the
// tiles, and leaves float32 images with the tiles' rounding only.
#pragma once

#include "types.h"

namespace beags {

struct View {
  double rotation[9];  // world to camera, row-major
  double translation[3];
  double kx[3], ky[3];  // first two rows of K; the third is (0, 0, 1)
  int width, height;    // pixels
  double near_plane, far_plane;

  // k in the distortion's m(d) = far / (far - near) - k / d: far near / (far - near).
  double mapping() const { return near_plane / (1 - near_plane / far_plane); }
};

struct SurfelParameters {
  double mean[3], quat[4], scale[2];
  double log2_opacity, transparency;  // transparency: 1 - opacity
};

struct ShapeGradients {
  double mean[3], quat[4], log_scale[2];
  double screen_shift[2];  // see rasterizers/interface.py
};

enum class Fate { kDrawn, kCulled, kNonFinite };

// Fills `splat` (but for colour and class) if the surfel is drawn.
Fate project(const View& view, const SurfelParameters& surfel, Splat<double>& splat);

// Whether rho3d <= rho2d wherever it is drawn, it lies wholly beyond the near plane and its alpha stays below the
// maximum: most surfels, which the kernels then draw without these distinctions.
bool is_plain(const View& view, const Splat<double>& splat);

// The gradient towards mean, quat, log_scale and screen shift, from that towards the splat's fields (`record`: kRecord
// sums).
ShapeGradients project_backward(const View& view, const SurfelParameters& surfel, const double* record);

}  // namespace beags
