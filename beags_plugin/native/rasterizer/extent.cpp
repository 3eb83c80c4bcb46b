#include "rasterizer/extent.h"

#if defined(__SSE2__)
#include <emmintrin.h>
#endif

namespace beags {
namespace {

// Four rows of groups at a time.
typedef float Four __attribute__((vector_size(16)));

#if defined(__SSE2__)  // one instruction each, with the same results
inline Four min(Four a, Four b) { return _mm_min_ps(a, b); }
inline Four max(Four a, Four b) { return _mm_max_ps(a, b); }
inline Four root(Four a) { return _mm_sqrt_ps(max(a, Four{})); }
#else
inline Four min(Four a, Four b) { return a < b ? a : b; }
inline Four max(Four a, Four b) { return a > b ? a : b; }
inline Four root(Four a) {  // The root of a negative number is 0.
  for (int i = 0; i < kGroup; ++i) a[i] = std::sqrt(a[i] > 0 ? a[i] : 0);
  return a;
}
#endif

}  // namespace

Bands Extent::bands(int tile_row) const {
  Bands out;
  if (everywhere_) {
    for (int i = 0; i < kGroup; ++i) {
      out.first[i] = 0;
      out.last[i] = (width_ - 1) / kGroup;
    }
    return out;
  }
  const Four zero = {}, limit = zero + static_cast<float>(width_);
  const Four y0 = Four{0, 1, 2, 3} * float(kGroup) + (static_cast<float>(tile_row * kTile) + 0.5f - cy_);
  const Four y1 = y0 + float(kGroup - 1);
  const Four low = y0 - (y_ + margin_), high = y1 - (y_ - margin_);  // the rows' centres, from the ellipse's
  // The ellipse reaches furthest to either side at its extreme point, or at the row nearest to it.
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
