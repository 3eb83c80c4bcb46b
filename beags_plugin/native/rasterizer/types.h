// Declares the plain data that the parts of the compiled rasterizer share: constants, one projected Gaussian, one job.
#pragma once

#include <cstdint>

namespace beags {

constexpr int kTile = 16;  // pixels along a tile's side
constexpr int kGroup = 4;  // pixels along a group's side; a tile has 4 x 4 groups, one mask bit each
constexpr int kTilePixels = kTile * kTile;
constexpr int kGroupPixels = kGroup * kGroup;
constexpr int tiles_along(int pixels) { return (pixels + kTile - 1) / kTile; }
constexpr double kLog2MinAlpha = -7.994353436858858;  // log2(1 / 255); this and the next two: rasterizers/interface.py
constexpr double kLargest = 1e18;  // world units; larger Gaussians, and those of larger depth, count as broken
constexpr double kMaxAlpha = 0.99;
constexpr double kMinTransmittance = 1e-4;
constexpr double kLn2 = 0.6931471805599453;
constexpr int kIgnore = 65535;
constexpr int64_t kMostTilePairs = 1 << 24;  // the kernels count a tile's pairs in T, exact up to here in float32
constexpr int kPrefetched = 4;  // pairs ahead whose splats are prefetched; as many unused pairs end the list

// One Gaussian as one view sees it (E1, E2). M is divided by the centre's depth and recentred on the projected centre
// c, so that with (dx, dy) = pixel - c the cross product is affine, q = dx A + dy B + C, and free of the scene's unit:
//   q0 = u_x dx + u_y dy,  q1 = v_x dx + v_y dy,  q2 = w_x dx + w_y dy + w_0,  depth = det / q2.
// The fields that every pixel needs fill the first cache line of a float32 splat.
template <class T>
struct alignas(32) Splat {
  T cx, cy;  // c, pixels
  T u_x, u_y, v_x, v_y;
  T w_x, w_y, w_0;
  T det, z;                    // z: depth of the centre, world units
  T nearness_det, nearness_z;  // k / det and k / z, with k of Job
  T log2_opacity;
  int32_t class_id;
  int32_t plain;  // see is_plain in projection.h
  T color[3];
  T normal[3];       // camera space, turned towards the camera
  T tilt_u, tilt_v;  // depth of t_u and t_v over the centre's: (a_z, b_z) / p_z
};
static_assert(sizeof(Splat<float>) == 96, "one and a half cache lines");

// A Gaussian that reaches a tile.
struct Pair {
  int32_t splat;
  int32_t record;  // index of its gradient record for this tile
  uint16_t mask;   // bit 4 row + column: the groups of the tile that it may reach
};

// The sums over pixels that the backward stores for each pair. With s = -2 dL/d rho3d / q2^2, a factor of the gradients
// of q0 and q1, and h = dL/dq2, these moments determine the gradient of u, v and w.
enum Record {
  kColor,
  kLogOpacity = kColor + 3,
  kSx,
  kSy,
  kSxx,
  kSxy,
  kSyy,  // sum of s times dx, dy, dx^2, dx dy, dy^2
  kH,
  kHx,
  kHy,  // sum of h times 1, dx, dy
  kCx,
  kCy,  // dL/dc through the low-pass disc
  kShapeEnd,
  kDet = kShapeEnd,
  kZ,
  kNormal,
  kRecordEnd = kNormal + 3
};
constexpr int kColorRecord = 4;   // numbers in a record where only colours are wanted; a multiple of 4
constexpr int kShapeRecord = 16;  // numbers in a record without geometry
constexpr int kRecord = 20;
static_assert(kShapeEnd <= kShapeRecord && kRecordEnd <= kRecord, "records hold their sums");

// The parts that a variant of the kernels computes besides colour and alpha.
using Parts = unsigned;
constexpr Parts kGeometry = 1, kDistortion = 2, kBoundary = 4;
constexpr Parts kAllParts = kGeometry | kDistortion | kBoundary;
constexpr Parts kClassChannels = 8;  // backward only: gradients of the sums of w by class alone
constexpr Parts kFeatures = 16;      // backward only: gradients of channels of features alone
constexpr int record_size(Parts parts) { return parts & (kGeometry | kDistortion) ? kRecord : kShapeRecord; }

// The images, [height, width, channels], or their gradients; null: not wanted.
template <class T>
struct Images {
  T *color, *alpha, *depth, *median_depth, *normal, *distortion, *boundary;
};

// The forward's results for the backward: [tiles, 256] each, in groups of 16 pixels; all null without a backward.
// Counts of pairs are numbers of T, which are exact up to 2^24.
template <class T>
struct Saved {
  T* end_transmittance;
  T* end;                        // pairs of the tile before the one at which the pixel stopped
  T *depth_sum, *median_pair;    // sum of w d; the pair at which T passes 0.5, or -1
  T *first, *moment1, *moment2;  // distortion: k / d of the first hit, sums of w m and w m^2 from there
  static constexpr int kCount = 7;
};

// Everything that the kernels of one tile read and write.
template <class T>
struct Job {
  int width, height, tiles_x, tiles_y;
  T near_plane;
  T mapping;  // k in m(d) = far / (far - near) - k / d; only differences of m count
  T background[3];
  const int32_t* target;  // [height, width] class ids, or null: no boundary

  const Splat<T>* splats;
  const int64_t* tile_start;  // [tiles + 1] into pairs
  const Pair* pairs;          // nearest first within a tile

  Images<T> images;
  Saved<T> saved;
  Images<const T> gradients;
  T* records;       // [pairs, record_size]
  T* g_background;  // [tiles, 3]
  // kClassChannels: the gradients of the sums of the tile's classes, 256 pixels each, and the place of a class there.
  const T* class_gradients;
  const int32_t* class_places;
  // Channels of features, whose number is a multiple of 4.
  int num_features;
  const T* features;           // [N, num_features]
  T* channels;                 // [height, width, num_features]
  const T* channel_gradients;  // the same
  T* feature_work;             // memory of one tile: num_features times 256 pixels, then times a register
  T* feature_records;          // [pairs, num_features]
};

// A Gaussian's w at a pixel; pair: its place among those of the tile.
template <class T>
struct Contribution {
  T w;
  int32_t pair;
};

// A query, which has no gradient (sections 3 and 5).
template <class T>
struct Query {
  const int32_t* labels;      // class_map: the class of a place
  const int32_t* slots;       // class_contributions: [height, width] index of the pixel's label in its tile, or -1
  const int32_t* num_slots;   // [tiles]
  const int64_t* slot_start;  // [tiles] into sums
  T* sums;                    // [pairs of t, num_slots[t]] for each tile t
  T min_weight;               // class_pixel_counts: pixels of larger w count
  int most, within;           // top_contributions: number of largest w that count, among the first ones of a pixel
  Contribution<T>* found;     // top_contributions: room for 256 times `within`, or times the pairs of t if fewer
  int32_t* classes;           // class_map, dominant_gaussian: [height, width]
  T* share;                   // class_map: [height, width]
  T* channels;                // class_channels: [height, width, num_channels]
  const T* channel_gradients;
  int num_channels;
};

// The work of the forward: pixel lanes that it evaluates, and (pixel, Gaussian) pairs that contribute.
struct Work {
  int64_t lanes, contributing;
};

// The kernels of one instruction set, for one tile each.
template <class T>
struct Variant {
  void (*forward)(const Job<T>&, int tile);
  void (*backward)(const Job<T>&, int tile);
  int record_size;
};
template <class T>
struct Kernels {
  Variant<T> variants[kAllParts + 1];                // indexed by Parts
  void (*backward_colors)(const Job<T>&, int tile);  // gradients of colours and background alone
  void (*feature_channels)(const Job<T>&, int tile);
  void (*feature_channels_backward)(const Job<T>&, int tile);
  void (*backward_features)(const Job<T>&, int tile);  // gradients of the features alone
  void (*class_contributions)(const Job<T>&, const Query<T>&, int tile);
  void (*class_pixel_counts)(const Job<T>&, const Query<T>&, int tile);
  void (*top_contributions)(const Job<T>&, const Query<T>&, int tile);
  void (*class_map)(const Job<T>&, const Query<T>&, int tile);
  void (*class_channels)(const Job<T>&, const Query<T>&, int tile);
  void (*class_channels_backward)(const Job<T>&, const Query<T>&, int tile);
  void (*dominant_gaussian)(const Job<T>&, const Query<T>&, int tile);
  Work (*count)(const Job<T>&, int tile);
};

}  // namespace beags
