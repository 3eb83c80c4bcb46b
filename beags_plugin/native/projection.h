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
};

struct SurfelParameters {
  double mean[3], quat[4], log_scale[2], opacity_logit, color[3];
};

struct SurfelGradients {
  double mean[3], quat[4], log_scale[2], opacity_logit;
};

enum class Fate { kDrawn, kCulled, kNonFinite };

// Fills `splat` (but for the class) if the surfel is drawn.
Fate project(const View& view, const SurfelParameters& surfel, Splat<double>& splat);

// The gradient towards the parameters, from that towards the splat's fields (`record`: kRecordSize sums).
SurfelGradients project_backward(const View& view, const SurfelParameters& surfel, const double* record);

// Where alpha can reach 1/255: the projected conic rho3d <= 2 ln(255 o), united with the low-pass disc.
class Extent {
 public:
  template <class T>
  Extent(const View& view, const Splat<T>& splat);

  // Whether its box touches the image; a surfel may do so and yet reach no pixel's centre.
  bool on_screen() const { return on_screen_; }
  // First and last row of pixels (inside the image; first > last: none).
  int first_row() const { return first_row_; }
  int last_row() const { return last_row_; }

  struct Columns {
    int first, last;  // pixels, inside the image; first > last: none
  };
  // Columns that the conic (which = 0) or the disc (which = 1) reaches in the rows row .. row + 3.
  Columns columns(int row, int which) const;

 private:
  Columns clip(double left, double right) const;
  double edge(double y, double side) const;

  int width_, height_, first_row_, last_row_;
  bool on_screen_ = true;
  bool everywhere_;               // the surfel's disc crosses the camera plane
  double cx_, cy_, disc_;         // pixels; the disc's radius
  double a_, b_, c_, d_, e_, f_;  // conic a x^2 + 2 b x y + c y^2 + 2 d x + 2 e y + f <= 0 around (cx, cy)
  double left_, right_, top_, bottom_, y_left_, y_right_;  // its box, and where it touches the box's sides
};

}  // namespace beags
