// What the parts of the compiled rasterizer share: constants, one projected surfel, one job. Plain data only.
#pragma once

#include <cstdint>

namespace beags {

constexpr int kTile = 16;  // pixels along a tile's side
constexpr int kGroup = 4;  // pixels along a group's side; a tile has 4 x 4 groups, one mask bit each
constexpr int kTilePixels = kTile * kTile;
constexpr int kGroupPixels = kGroup * kGroup;
constexpr int tiles_along(int pixels) { return (pixels + kTile - 1) / kTile; }
constexpr double kLogMinAlpha =
    -5.541263545158426;  // log(1 / 255); this and the next two as in rasterizers/interface.py
constexpr double kMaxAlpha = 0.99;
constexpr double kMinTransmittance = 1e-4;
constexpr int kIgnore = 65535;

// One surfel as one view sees it (E1, E2). M is divided by the centre's depth and recentred on the projected centre c,
// so that with (dx, dy) = pixel - c the cross product is affine, q = dx A + dy B + C, and free of the scene's unit:
//   q0 = u_x dx + u_y dy,  q1 = v_x dx + v_y dy,  q2 = w_x dx + w_y dy + w_0,  depth = det / q2.
template <class T>
struct Splat {
  T cx, cy;  // c, pixels
  T u_x, u_y, v_x, v_y;
  T w_x, w_y, w_0;
  T det;
  T z;  // depth of the centre, world units
  T log_opacity;
  T tilt_u, tilt_v;  // depth of t_u and t_v over the centre's: (a_z, b_z) / p_z
  T color[3];
  T normal[3];  // camera space, turned towards the camera
  int32_t class_id;
};

// A surfel that reaches a tile.
struct Pair {
  int32_t splat;
  int32_t record;  // where its gradient record of this tile goes
  uint16_t mask;   // bit 4 row + column: the groups of the tile that it may reach
};

// The sums over pixels that the backward keeps for each pair: the gradient towards the fields of a Splat.
enum Record {
  kQ0,
  kQ0x,
  kQ0y,  // sum of dL/dq0, and of that times dx and dy
  kQ1,
  kQ1x,
  kQ1y,
  kQ2,
  kQ2x,
  kQ2y,
  kDet,
  kZ,
  kCx,
  kCy,  // kCx, kCy: through the low-pass disc only
  kLogOpacity,
  kColor,
  kNormal = kColor + 3,
  kRecordSize = kNormal + 3
};

// Everything that the kernels of one tile read and write. Images are [height, width, channels]; what the forward saves
// for the backward is [tiles, 256], in groups of 16 pixels.
template <class T>
struct Job {
  int width, height, tiles_x, tiles_y;
  T near_plane;
  T mapping;  // k in m(d) = far / (far - near) - k / d, k = far near / (far - near): differences of m need k alone
  T background[3];
  bool geometry, distortion;
  const int32_t* target;  // [height, width] class ids, or null: no boundary

  const Splat<T>* splats;
  const int64_t* tile_start;  // [tiles + 1] into pairs
  const Pair* pairs;          // nearest first within a tile

  T *color, *alpha, *depth, *median_depth, *normal, *distortion_out, *boundary;

  T* end_transmittance;
  int32_t* last;                               // one past the last contributing pair, counted in the tile
  int32_t* median_pair;                        // the pair at which T passes 0.5, or -1
  T* depth_sum;                                // sum of w d
  T *first_inverse_depth, *moment1, *moment2;  // distortion: 1 / d of the first hit, sums of w m and w m^2 from there

  const T *g_color, *g_alpha, *g_depth, *g_median_depth, *g_normal, *g_distortion, *g_boundary;  // null: no gradient
  T* records;                                                                                    // [pairs, kRecordSize]
  T* g_background;                                                                               // [tiles, 3]
};

// The products without gradients (sections 3 and 5).
template <class T>
struct Product {
  const int32_t* labels;      // [height, width] or null
  const int32_t* slots;       // class_contributions: [height, width] index of the pixel's label in its tile, or -1
  const int32_t* num_slots;   // [tiles]
  const int64_t* slot_start;  // [tiles] into sums
  T* sums;                    // of tile t: [pairs of t, num_slots[t]]
  int32_t* classes;           // class_map, heaviest: [height, width]
  T* share;                   // class_map: [height, width]
};

// The kernels of one instruction set, for one tile each.
template <class T>
struct Kernels {
  void (*forward)(const Job<T>&, int tile);
  void (*backward)(const Job<T>&, int tile);
  void (*class_contributions)(const Job<T>&, const Product<T>&, int tile);
  void (*class_map)(const Job<T>&, const Product<T>&, int tile);
  void (*heaviest)(const Job<T>&, const Product<T>&, int tile);
};

namespace baseline {
extern const Kernels<float> kKernelsF32;
extern const Kernels<double> kKernelsF64;
}  // namespace baseline
namespace avx2 {
extern const Kernels<float> kKernelsF32;
extern const Kernels<double> kKernelsF64;
}  // namespace avx2

}  // namespace beags
