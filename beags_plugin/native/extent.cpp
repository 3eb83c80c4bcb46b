#include "extent.h"

#include <algorithm>
#include <cmath>

namespace beags {
namespace {

// The disc of `r2` = squared standard deviations, projected: x^T D x for the lines x that touch it, D = M diag(r2, r2,
// -1) M^T. Its entries give the box.
struct DualConic {
  double xx, xy, yy, xw, yw, ww;

  template <class T>
  DualConic(const Splat<T>& s, double r2) {
    const double mu[2] = {s.v_y, -s.u_y}, mv[2] = {-s.v_x, s.u_x}, tilt[2] = {s.tilt_u, s.tilt_v};
    xx = r2 * (mu[0] * mu[0] + mu[1] * mu[1]);
    xy = r2 * (mu[0] * mv[0] + mu[1] * mv[1]);
    yy = r2 * (mv[0] * mv[0] + mv[1] * mv[1]);
    xw = r2 * (mu[0] * tilt[0] + mu[1] * tilt[1]);
    yw = r2 * (mv[0] * tilt[0] + mv[1] * tilt[1]);
    ww = r2 * (tilt[0] * tilt[0] + tilt[1] * tilt[1]) - 1;
  }
  // Of the ellipse that it is where ww < 0: half the box's sides, and the covariance of which they are the diagonal.
  double half_width() const { return std::sqrt(std::max(0.0, xw * xw - xx * ww)) / -ww; }
  double half_height() const { return std::sqrt(std::max(0.0, yw * yw - yy * ww)) / -ww; }
  double covariance() const { return (xw * yw - xy * ww) / (ww * ww); }
};

}  // namespace

template <class T>
Extent::Extent(const View& view, const Splat<T>& s)
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
    // The root of the covariance matrix's determinant over that of its yy entry: det D = -(r2 det M)^2 gives it without
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

template Extent::Extent(const View&, const Splat<float>&);
template Extent::Extent(const View&, const Splat<double>&);

Bands Extent::bands(int tile_row) const {
  Bands out;
  if (everywhere_) {
    for (int i = 0; i < kGroup; ++i) {
      out.first[i] = 0;
      out.last[i] = (width_ - 1) / kGroup;
    }
    return out;
  }
  // Four rows of groups at a time.
  typedef float Four __attribute__((vector_size(16)));
  const auto min = [](Four a, Four b) { return a < b ? a : b; };
  const auto max = [](Four a, Four b) { return a > b ? a : b; };
  const auto root = [](Four a) {  // 0 for negative numbers
    for (int i = 0; i < kGroup; ++i) a[i] = std::sqrt(a[i] > 0 ? a[i] : 0);
    return a;
  };
  const Four zero = {}, limit = zero + static_cast<float>(width_);
  const Four y0 = Four{0, 1, 2, 3} * float(kGroup) + (static_cast<float>(tile_row * kTile) + 0.5f - cy_);
  const Four y1 = y0 + float(kGroup - 1);
  const Four low = y0 - (y_ + margin_), high = y1 - (y_ - margin_);  // the rows' centres, from the ellipse's
  // Where the ellipse reaches furthest to either side: at its extreme point, or as near to it as the rows come.
  const auto nearest = [&](float y) {
    return min(max(min(max(zero + y, low), high), zero - half_height_), zero + half_height_);
  };
  const auto half_width = [&](Four y) {
    const Four t = y / half_height_;
    return width_at_centre_ * root(1 + 4e-7f - t * t);  // rounded up: the root is steep at 0
  };
  const Four y_left = nearest(-y_right_), y_right = nearest(y_right_);
  const auto meets = (low <= half_height_) & (high >= -half_height_);
  const Four left = meets ? x_ + slope_ * y_left - half_width(y_left) : limit;
  const Four right = meets ? x_ + slope_ * y_right + half_width(y_right) : -limit;
  const Four y = min(max(zero, y0), y1), square = disc_ * disc_ - y * y;
  const Four half = square > 0 ? root(square) : -limit;
  // Centres of pixels lie at 0.5; truncation rounds down, as these are not negative.
  const Four first = min(max(min(left, -half) + (cx_ + 0.5f - margin_), zero), limit);
  const Four last = min(max(max(right, half) + (cx_ + 0.5f + margin_), zero), limit);
  for (int i = 0; i < kGroup; ++i) {
    const int first_pixel = static_cast<int>(first[i]), end_pixel = static_cast<int>(last[i]);
    out.first[i] = first_pixel / kGroup;
    out.last[i] = end_pixel > first_pixel ? (end_pixel - 1) / kGroup : -1;
  }
  return out;
}

template <class T>
int64_t tiles_of_usual_box(const View& view, const Splat<T>& s) {
  const DualConic conic(s, 3.33 * 3.33);
  const int tiles_x = tiles_along(view.width), tiles_y = tiles_along(view.height);
  if (!(conic.ww < 0)) return static_cast<int64_t>(tiles_x) * tiles_y;
  const auto tiles = [](double center, double half, int count) {
    const double first = std::floor((center - half) / kTile), end = std::ceil((center + half) / kTile);
    return static_cast<int64_t>(std::max(0.0, std::min(end, double(count)) - std::max(first, 0.0)));
  };
  return tiles(s.cx + conic.xw / conic.ww, conic.half_width(), tiles_x) *
         tiles(s.cy + conic.yw / conic.ww, conic.half_height(), tiles_y);
}
template int64_t tiles_of_usual_box(const View&, const Splat<float>&);
template int64_t tiles_of_usual_box(const View&, const Splat<double>&);

}  // namespace beags
