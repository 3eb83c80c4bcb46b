// Which pixels a surfel can reach.
#pragma once

#include <cstdint>

#include "projection.h"
#include "types.h"

namespace beags {

// A tile's four rows of groups, and the columns of groups that a surfel reaches in each; first > last: none.
struct Bands {
  int first[kGroup], last[kGroup];
};

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
  // A superset of what is reached in one row of tiles, as tight as one interval per row of groups can be.
  Bands bands(int tile_row) const;

 private:
  int width_, first_row_ = 0, last_row_;
  bool on_screen_ = true;
  bool everywhere_ = true;     // the surfel's disc crosses the camera plane, or nearly so
  float cx_, cy_, disc_;       // pixels; the disc's radius
  float margin_;               // pixels; what rounding may hide
  float x_, y_, half_height_;  // the conic, an ellipse: its centre, from (cx, cy), and half its box's height
  float width_at_centre_, slope_, y_right_;  // half its width on its centre's row; how far the chord's middle moves per
                                             // row; where it touches its box on the right, from its centre
};

// How many tiles the usual bound meets: a box of 3.33 standard deviations around the projected disc.
template <class T>
int64_t tiles_of_usual_box(const View& view, const Splat<T>& splat);

}  // namespace beags
