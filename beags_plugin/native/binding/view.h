// Makes a View from Python's camera.
#pragma once

#include <algorithm>
#include <stdexcept>
#include <vector>

#include "rasterizer/projection.h"

namespace beags {

using Matrix = std::vector<std::vector<double>>;  // row by row

inline View make_view(const Matrix& viewmat, const Matrix& k, int width, int height, double near_plane,
                      double far_plane) {
  const auto is = [](const Matrix& m, size_t size) {
    return m.size() == size && std::all_of(m.begin(), m.end(), [&](const auto& row) { return row.size() == size; });
  };
  if (!is(viewmat, 4) || !is(k, 3)) throw std::invalid_argument("viewmat must be 4 x 4 and K 3 x 3");
  View view{};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) view.rotation[3 * row + column] = viewmat[row][column];
    view.translation[row] = viewmat[row][3];
    view.kx[row] = k[0][row];
    view.ky[row] = k[1][row];
  }
  view.width = width;
  view.height = height;
  view.near_plane = near_plane;
  view.far_plane = far_plane;
  return view;
}

}  // namespace beags
