#include "ops/voxel_lookup.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace beags {
namespace ops {
using namespace BEAGS_ISA;
namespace {

// An array of bricks has at most kMostDense cells, or kDensePerBrick per non-empty brick if that is more. A hash table
// has 4 to 8 cells per brick.
constexpr double kMostDense = 1 << 16, kDensePerBrick = 16;
constexpr int64_t kLeastForTeam = 4000;  // Queries take tens of nanoseconds; a team takes microseconds to start.

// Sorts by key and unites the bits of equal keys.
void unite(std::vector<Brick>& bricks) {
  std::sort(bricks.begin(), bricks.end(), [](const Brick& a, const Brick& b) { return a.key < b.key; });
  size_t last = 0;
  for (size_t i = 1; i < bricks.size(); ++i) {
    if (bricks[i].key == bricks[last].key) {
      bricks[last].bits |= bricks[i].bits;
    } else {
      bricks[++last] = bricks[i];
    }
  }
  if (!bricks.empty()) bricks.resize(last + 1);
}

// Appends the bricks of the box of 3 x 3 x 3 voxels around a voxel; `voxel` already includes kVoxelShift.
void add_neighbours(const int64_t* voxel, std::vector<Brick>& bricks) {
  int64_t brick[3][2];
  int count[3], first[3];
  for (int axis = 0; axis < 3; ++axis) {
    brick[axis][0] = (voxel[axis] - 1) >> 2;
    brick[axis][1] = (voxel[axis] + 1) >> 2;
    first[axis] = static_cast<int>((voxel[axis] - 1) & 3);
    count[axis] = brick[axis][1] > brick[axis][0] ? 2 : 1;
  }
  // Returns the bits of one axis that lie in its first or second brick.
  const auto span = [&](int axis, int which) {
    const unsigned bits = 7u << first[axis];
    return which == 0 ? bits & 0xF : bits >> 4;
  };
  for (int i = 0; i < count[0]; ++i) {
    for (int j = 0; j < count[1]; ++j) {
      for (int k = 0; k < count[2]; ++k) {
        const unsigned xs = span(0, i), ys = span(1, j), zs = span(2, k);
        uint64_t bits = 0;
        for (int x = 0; x < 4; ++x) {
          for (int y = 0; y < 4; ++y) {
            if (xs >> x & ys >> y & 1) bits |= static_cast<uint64_t>(zs) << (16 * x + 4 * y);
          }
        }
        bricks.push_back({brick_key(brick[0][i], brick[1][j], brick[2][k]), bits});
      }
    }
  }
}

int64_t coordinate(uint64_t key, int axis) { return static_cast<int64_t>(key >> (40 - 20 * axis) & 0xFFFFF); }

// Returns the voxels of `table`, whose bricks are `bricks`, that are the corner of 2 x 2 x 2 of them.
std::vector<std::vector<Brick>> corners(const VoxelTable& table, const std::vector<std::vector<Brick>>& bricks) {
  std::vector<std::vector<Brick>> out(bricks.size());
  const int sizes[3] = {4, 4, 4};
  for (size_t c = 0; c < bricks.size(); ++c) {
    for (const Brick& brick : bricks[c]) {
      uint64_t bits = brick.bits;
      for (int offset = 1; offset < 8 && bits; ++offset) {
        int64_t low[3];
        for (int axis = 0; axis < 3; ++axis) {
          low[axis] = 4 * coordinate(brick.key, axis) - kVoxelShift + (offset >> axis & 1);
        }
        bits &= voxel_box(table, static_cast<int32_t>(c), low, sizes);
      }
      if (bits) out[c].push_back({brick.key, bits});
    }
  }
  return out;
}

}  // namespace

void VoxelLookup::Bricks::store(const std::vector<std::vector<Brick>>& bricks) {
  num_classes = static_cast<int32_t>(bricks.size());
  int64_t low[3], high[3], count = 0;
  std::fill_n(low, 3, int64_t(1) << 20);
  std::fill_n(high, 3, int64_t(0));
  for (const std::vector<Brick>& of_class : bricks) {
    count += static_cast<int64_t>(of_class.size());
    for (const Brick& brick : of_class) {
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = std::min(low[axis], coordinate(brick.key, axis));
        high[axis] = std::max(high[axis], coordinate(brick.key, axis));
      }
    }
  }
  double cells = num_classes;
  for (int axis = 0; axis < 3; ++axis) {
    base[axis] = static_cast<int32_t>(low[axis] - 2);
    size[axis] = static_cast<int32_t>(std::max<int64_t>(high[axis] - low[axis], 0) + 5);
    cells *= size[axis];
  }
  if (cells > kMostDense && cells > kDensePerBrick * static_cast<double>(count)) return hash(bricks);
  dense.assign(static_cast<size_t>(cells), 0);
  for (int c = 0; c < num_classes; ++c) {
    for (const Brick& brick : bricks[c]) {
      int64_t at = c;
      for (int axis = 0; axis < 3; ++axis) at = at * size[axis] + coordinate(brick.key, axis) - base[axis];
      dense[at] = brick.bits;
    }
  }
}

void VoxelLookup::Bricks::hash(const std::vector<std::vector<Brick>>& bricks) {
  uint64_t first = 0;
  for (const std::vector<Brick>& of_class : bricks) {
    int bits = 1;
    while ((uint64_t(1) << bits) < 2 * of_class.size()) ++bits;  // Tables at most half full have short chains.
    ranges.push_back({first, (uint64_t(1) << bits) - 1, 64 - bits});
    first += uint64_t(1) << bits;
  }
  slots.assign(first, {kNoBrick, 0});
  for (size_t c = 0; c < bricks.size(); ++c) {
    const BrickRange& range = ranges[c];
    for (const Brick& brick : bricks[c]) {
      uint64_t at = brick.key * kGolden >> range.shift;
      while (slots[range.first + at].key != kNoBrick) at = (at + 1) & range.mask;
      slots[range.first + at] = brick;
    }
  }
}

VoxelTable VoxelLookup::Bricks::table() const {
  VoxelTable table{};
  table.num_classes = num_classes;
  table.dense = dense.empty() ? nullptr : dense.data();
  std::copy_n(base, 3, table.base);
  std::copy_n(size, 3, table.size);
  table.bricks = slots.data();
  table.classes = ranges.data();
  return table;
}

int64_t VoxelLookup::Bricks::bytes() const {
  return static_cast<int64_t>(dense.size() * sizeof(uint64_t) + slots.size() * sizeof(Brick) +
                              ranges.size() * sizeof(BrickRange));
}

VoxelLookup::VoxelLookup(const int64_t* keys, const int32_t* classes, int64_t count, int num_classes,
                         const double* origin, double voxel_size)
    : voxel_size_(voxel_size) {
  std::copy_n(origin, 3, origin_);
  std::vector<std::vector<Brick>> occupied(num_classes), valid(num_classes);
  std::vector<size_t> unite_at(num_classes, 1 << 16);
  for (int64_t i = 0; i < count; ++i) {
    constexpr int64_t kMask = (1 << 21) - 1;
    int64_t voxel[3] = {keys[i] >> 42 & kMask, keys[i] >> 21 & kMask, keys[i] & kMask};  // voxel + kVoxelHalf
    for (int64_t& index : voxel) index += kVoxelShift - kVoxelHalf;
    const int c = classes[i];
    const uint64_t bit = uint64_t(1) << (16 * (voxel[0] & 3) + 4 * (voxel[1] & 3) + (voxel[2] & 3));
    occupied[c].push_back({brick_key(voxel[0] >> 2, voxel[1] >> 2, voxel[2] >> 2), bit});
    add_neighbours(voxel, valid[c]);
    if (valid[c].size() >= unite_at[c]) {  // Memory stays linear in the bricks, not in the voxels.
      unite(occupied[c]);
      unite(valid[c]);
      unite_at[c] = std::max<size_t>(1 << 16, 2 * valid[c].size());
    }
  }
  for (int c = 0; c < num_classes; ++c) {
    unite(occupied[c]);
    unite(valid[c]);
  }
  occupied_.store(occupied);
  cubes_[0].store(valid);
  for (int side = 1; side < kLargestCube; ++side) {
    valid = corners(cubes_[side - 1].table(), valid);
    cubes_[side].store(valid);
  }
}

std::array<VoxelTable, kLargestCube> VoxelLookup::valid_cubes() const {
  std::array<VoxelTable, kLargestCube> tables;
  for (int side = 0; side < kLargestCube; ++side) tables[side] = cubes_[side].table();
  return tables;
}

int64_t VoxelLookup::bytes() const {
  int64_t sum = occupied_.bytes();
  for (const Bricks& cubes : cubes_) sum += cubes.bytes();
  return sum;
}

// Each step is monotonic, as in VisibilityGrid's _scaled.
template <class T>
void VoxelLookup::scaled(const T* point, T* voxel) const {
  for (int axis = 0; axis < 3; ++axis) {
    voxel[axis] = std::floor((point[axis] - static_cast<T>(origin_[axis])) / static_cast<T>(voxel_size_));
  }
}

template <class T>
void VoxelLookup::count_occupied(int64_t count, const T* points, const int32_t* class_ids, int64_t* out,
                                 int threads) const {
  const VoxelTable table = occupied();
  const int team = count < kLeastForTeam ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < count; ++i) {
    T voxel[3];
    scaled(points + 3 * i, voxel);
    out[i] = 0;
    const T half = static_cast<T>(kVoxelHalf);
    if (!(std::abs(voxel[0]) < half && std::abs(voxel[1]) < half && std::abs(voxel[2]) < half)) continue;
    const int sizes[3] = {3, 3, 3};
    int64_t low[3];
    for (int axis = 0; axis < 3; ++axis) low[axis] = static_cast<int64_t>(voxel[axis]) - 1;
    out[i] = __builtin_popcountll(voxel_box(table, class_ids[i], low, sizes) & box_bits(3, 3, 3));
  }
}

template <class T>
void VoxelLookup::is_valid(int64_t count, const T* points, const int32_t* class_ids, bool* out, int threads) const {
  const VoxelTable table = valid();
  const int team = count < kLeastForTeam ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < count; ++i) {
    T voxel[3];
    scaled(points + 3 * i, voxel);
    out[i] = voxel_member(table, class_ids[i], voxel);
  }
}

template <class T>
void VoxelLookup::disc_inside(int64_t count, const T* means, const T* axes_u, const T* axes_v, const int32_t* class_ids,
                              bool* out, int threads) const {
  const VoxelTable table = valid();
  const T rounding = 16 * std::numeric_limits<T>::epsilon();  // the margin of VisibilityGrid's disc_inside
  const int team = count < kLeastForTeam ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < count; ++i) {
    T low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) {
      const T mean = means[3 * i + axis], u = axes_u[3 * i + axis], v = axes_v[3 * i + axis];
      const T origin = static_cast<T>(origin_[axis]);
      const T half = std::sqrt(u * u + v * v) * (1 + rounding) + rounding * (std::abs(mean) + std::abs(origin));
      low[axis] = mean - half;
      high[axis] = mean + half;
    }
    T from[3], to[3];
    scaled(low, from);
    scaled(high, to);
    int64_t corner[3];
    int n[3];
    out[i] = false;
    if (!small_box(from, to, corner, n)) continue;
    const uint64_t box = box_bits(n[0], n[1], n[2]);
    out[i] = (voxel_box(table, class_ids[i], corner, n) & box) == box;
  }
}

#define BEAGS_INSTANTIATE(T)                                                                         \
  template void VoxelLookup::count_occupied(int64_t, const T*, const int32_t*, int64_t*, int) const; \
  template void VoxelLookup::is_valid(int64_t, const T*, const int32_t*, bool*, int) const;          \
  template void VoxelLookup::disc_inside(int64_t, const T*, const T*, const T*, const int32_t*, bool*, int) const;
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace ops
}  // namespace beags
