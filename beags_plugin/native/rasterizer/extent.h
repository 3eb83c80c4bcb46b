// Bounds the pixels that a Gaussian reaches, on the CPU and on GPUs (`bands` on the CPU only).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "rasterizer/projection.h"
#include "rasterizer/types.h"

namespace beags {

// The columns of groups that a Gaussian reaches in each of a tile's four rows of groups; first > last: none.
struct Bands {
  int first[kGroup], last[kGroup];
};

// The disc of `r2` = squared standard deviations, projected: x^T D x for the lines x that touch it, D = M diag(r2, r2,
// -1) M^T. Its entries give the box.
struct DualConic {
  double xx, xy, yy, xw, yw, ww;

  template <class T>
  BEAGS_HD DualConic(const Splat<T>& s, double r2) {
    const double mu[2] = {s.v_y, -s.u_y}, mv[2] = {-s.v_x, s.u_x}, tilt[2] = {s.tilt_u, s.tilt_v};
    xx = r2 * (mu[0] * mu[0] + mu[1] * mu[1]);
    xy = r2 * (mu[0] * mv[0] + mu[1] * mv[1]);
    yy = r2 * (mv[0] * mv[0] + mv[1] * mv[1]);
    xw = r2 * (mu[0] * tilt[0] + mu[1] * tilt[1]);
    yw = r2 * (mv[0] * tilt[0] + mv[1] * tilt[1]);
    ww = r2 * (tilt[0] * tilt[0] + tilt[1] * tilt[1]) - 1;
  }
  // For ww < 0 it is an ellipse: half the box's sides, which are the roots of the covariance's diagonal.
  BEAGS_HD double half_width() const { return std::sqrt(std::max(0.0, xw * xw - xx * ww)) / -ww; }
  BEAGS_HD double half_height() const { return std::sqrt(std::max(0.0, yw * yw - yy * ww)) / -ww; }
  BEAGS_HD double covariance() const { return (xw * yw - xy * ww) / (ww * ww); }
};

// The region where alpha can reach 1/255: the projected conic rho3d <= 2 ln(255 o), united with the low-pass disc.
class Extent {
 public:
  template <class T>
  BEAGS_HD Extent(const View& view, const Splat<T>& splat);

  // Returns whether its box touches the image; a Gaussian may do so and yet reach no pixel's centre.
  BEAGS_HD bool on_screen() const { return on_screen_; }
  // Return the first and last row of pixels inside the image; first > last: none.
  BEAGS_HD int first_row() const { return first_row_; }
  BEAGS_HD int last_row() const { return last_row_; }
  // Returns a superset of the groups reached in one row of tiles, as tight as one interval per row of groups can be.
  Bands bands(int tile_row) const;
  // Sets this superset for one row of groups, counted from the image's top; first > last: none.
  BEAGS_HD void band(int group_row, int& first_group, int& last_group) const;

 private:
  int width_, first_row_ = 0, last_row_;
  bool on_screen_ = true;
  bool everywhere_ = true;     // the Gaussian's disc crosses the camera plane, or nearly so
  float cx_, cy_, disc_;       // pixels; the disc's radius
  float margin_;               // a margin for rounding, pixels
  float x_, y_, half_height_;  // the conic, an ellipse: its centre, from (cx, cy), and half its box's height
  float width_at_centre_, slope_, y_right_;  // half its width on its centre's row; how far the chord's middle moves per
                                             // row; where it touches its box on the right, from its centre
};

template <class T>
BEAGS_HD Extent::Extent(const View& view, const Splat<T>& s)
    : width_(view.width), last_row_(view.height - 1), cx_(static_cast<float>(s.cx)), cy_(static_cast<float>(s.cy)) {
  const double r2 = std::max(0.0, 2 * kLn2 * (s.log2_opacity - kLog2MinAlpha));  // rho <= r2
  const double disc = std::sqrt(r2 / 2);
  disc_ = static_cast<float>(disc);
  const DualConic conic(s, r2);
  if (!(conic.ww < 0)) return;
  const double half_width = conic.half_width(), half_height = conic.half_height();
  const double x = conic.xw / conic.ww, y = conic.yw / conic.ww;
  on_screen_ = s.cx + std::min(x - half_width, -disc) < view.width && s.cx + std::max(x + half_width, disc) > 0 &&
               s.cy + std::min(y - half_height, -disc) < view.height && s.cy + std::max(y + half_height, disc) > 0;
  const double size = std::abs(s.cx) + std::abs(s.cy) + std::abs(x) + std::abs(y) + half_width + half_height;
  // Within 1e-3 of the camera plane, or for millions of pixels, float32's rounding would spoil the bound.
  everywhere_ = !(conic.ww < -1e-3 && size < 1e6);
  if (everywhere_) return;

  margin_ = static_cast<float>(0.01 + 1e-6 * size);
  x_ = static_cast<float>(x);
  y_ = static_cast<float>(y);
  half_height_ = static_cast<float>(half_height);
  if (half_height > 1e-6) {
    const double covariance = conic.covariance();
    slope_ = static_cast<float>(covariance / (half_height * half_height));
    y_right_ = half_width > 0 ? static_cast<float>(covariance / half_width) : 0.0f;
    // The root of the covariance matrix's determinant over that of its yy entry. det D = -(r2 det M)^2 gives it without
    // cancellation, however thin the ellipse is.
    const double width = r2 * std::abs(s.w_0) / (-conic.ww * std::sqrt(-conic.ww) * half_height);
    width_at_centre_ = static_cast<float>(std::min(width, half_width));
  } else {
    half_height_ = 1e-6f;
    slope_ = y_right_ = 0;
    width_at_centre_ = static_cast<float>(half_width);
  }
  const double first = std::ceil(s.cy + std::min(y - half_height, -disc) - 0.5 - margin_);
  const double last = std::floor(s.cy + std::max(y + half_height, disc) - 0.5 + margin_);
  first_row_ = static_cast<int>(std::clamp(first, 0.0, static_cast<double>(view.height)));
  last_row_ = static_cast<int>(std::clamp(last, -1.0, view.height - 1.0));
}

BEAGS_HD inline void Extent::band(int group_row, int& first_group, int& last_group) const {
  first_group = 0;
  last_group = (width_ - 1) / kGroup;
  if (everywhere_) return;
  const float limit = static_cast<float>(width_);
  const float y0 = static_cast<float>(group_row * kGroup) + 0.5f - cy_, y1 = y0 + float(kGroup - 1);
  const float low = y0 - (y_ + margin_), high = y1 - (y_ - margin_);  // the rows' centres, from the ellipse's
  float left = limit, right = -limit;
  if (low <= half_height_ && high >= -half_height_) {
    // The ellipse reaches furthest to either side at its extreme point, or at the row nearest to it.
    const auto side = [&](float y, float sign) {
      const float at = std::min(std::max(std::min(std::max(y, low), high), -half_height_), half_height_);
      const float t = at / half_height_, square = 1 + 4e-7f - t * t;  // rounded up: the root is steep at 0
      return x_ + slope_ * at + sign * width_at_centre_ * std::sqrt(square > 0 ? square : 0.0f);
    };
    left = side(-y_right_, -1.0f);
    right = side(y_right_, 1.0f);
  }
  const float y = std::min(std::max(0.0f, y0), y1), square = disc_ * disc_ - y * y;
  const float half = square > 0 ? std::sqrt(square) : -limit;
  // Centres of pixels lie at 0.5; truncation rounds down, as these are not negative.
  const float first = std::min(std::max(std::min(left, -half) + (cx_ + 0.5f - margin_), 0.0f), limit);
  const float last = std::min(std::max(std::max(right, half) + (cx_ + 0.5f + margin_), 0.0f), limit);
  const int first_pixel = static_cast<int>(first), end_pixel = static_cast<int>(last);
  first_group = first_pixel / kGroup;
  last_group = end_pixel > first_pixel ? (end_pixel - 1) / kGroup : -1;
}

// Counts the tiles of the usual bound: a box of 3.33 standard deviations around the projected disc.
template <class T>
int64_t tiles_of_usual_box(const View& view, const Splat<T>& splat);

}  // namespace beags
