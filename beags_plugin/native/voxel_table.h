// Sets of voxels, one for each class, as bricks of 4 x 4 x 4 voxels with a bit for each, in a hash table. One query
// reads 64 voxels, and memory is linear in the occupied voxels. Plain data and inlined queries, which kernels of every
// instruction set share: hence the namespace BEAGS_ISA.
#pragma once

#include <math.h>
#include <stdint.h>

namespace beags {
namespace ops {

constexpr int64_t kVoxelHalf = int64_t(1) << 20;   // occupied voxels lie in -kVoxelHalf .. kVoxelHalf - 1
constexpr int64_t kVoxelShift = kVoxelHalf + 8;    // added to an index before it is cut into brick and place
constexpr uint64_t kNoBrick = ~uint64_t(0);        // key of an empty slot; bricks use 60 bits
constexpr uint64_t kGolden = 0x9E3779B97F4A7C15u;  // 2^64 / golden ratio

struct Brick {
  uint64_t key, bits;  // bit 16 x + 4 y + z
};

// The slots of one class: 2^(64 - shift) of them, from `first` on.
struct BrickRange {
  uint64_t first, mask;
  int shift;
};

struct VoxelTable {
  const Brick* bricks;
  const BrickRange* classes;
  int32_t num_classes;
};

namespace BEAGS_ISA {

// Brick coordinates in 0 .. 2^20 - 1.
inline uint64_t brick_key(int64_t x, int64_t y, int64_t z) {
  return static_cast<uint64_t>(x) << 40 | static_cast<uint64_t>(y) << 20 | static_cast<uint64_t>(z);
}

inline uint64_t brick_bits(const VoxelTable& table, const BrickRange& range, uint64_t key) {
  for (uint64_t at = key * kGolden >> range.shift;; at = (at + 1) & range.mask) {
    const Brick& brick = table.bricks[range.first + at];
    if (brick.key == key) return brick.bits;
    if (brick.key == kNoBrick) return 0;
  }
}

// The same four bits in every one of 16 rows; the same 16 bits in every one of 4 slices.
inline uint64_t in_rows(uint64_t bits) { return bits * 0x1111111111111111u; }
inline uint64_t in_slices(uint64_t bits) { return bits * 0x0001000100010001u; }

// Bits of the box of sizes 1..4 whose corner is voxel 0.
inline uint64_t box_bits(int nx, int ny, int nz) {
  const uint64_t row = (1u << nz) - 1, slice = row * 0x1111u & ((uint64_t(1) << 4 * ny) - 1);
  return nx == 4 ? in_slices(slice) : in_slices(slice) & ((uint64_t(1) << 16 * nx) - 1);
}

// The voxels of the box of sizes n[] in 1..4 whose corner is voxel low[], |low| <= kVoxelHalf + 2: bit 16 x + 4 y + z
// is the voxel low + (x, y, z). Other bits may be set.
inline uint64_t voxel_box(const VoxelTable& table, int32_t class_id, const int64_t* low, const int* n) {
  if (class_id < 0 || class_id >= table.num_classes) return 0;
  const BrickRange range = table.classes[class_id];
  int64_t brick[3];
  int place[3], count[3];
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t index = low[axis] + kVoxelShift;
    brick[axis] = index >> 2;
    place[axis] = static_cast<int>(index & 3);
    count[axis] = place[axis] + n[axis] > 4 ? 2 : 1;
  }
  uint64_t all = 0;
  for (int i = 0; i < count[0]; ++i) {
    for (int j = 0; j < count[1]; ++j) {
      for (int k = 0; k < count[2]; ++k) {
        uint64_t bits = brick_bits(table, range, brick_key(brick[0] + i, brick[1] + j, brick[2] + k));
        if (bits == 0) continue;
        // Move voxel `place` to voxel 0 along each axis, and drop what belongs to the neighbouring bricks.
        bits = i ? bits << 16 * (4 - place[0]) : bits >> 16 * place[0];
        const uint64_t rows = (uint64_t(1) << 4 * (4 - place[1])) - 1, cells = (uint64_t(1) << (4 - place[2])) - 1;
        bits = j ? bits << 4 * (4 - place[1]) & in_slices(~rows & 0xFFFF) : bits >> 4 * place[1] & in_slices(rows);
        bits = k ? bits << (4 - place[2]) & in_rows(~cells & 0xF) : bits >> place[2] & in_rows(cells);
        all |= bits;
      }
    }
  }
  return all;
}

// Membership of the voxel that is given as whole numbers in floating point, which need not be finite.
template <class T>
inline bool voxel_member(const VoxelTable& table, int32_t class_id, const T* voxel) {
  const T limit = static_cast<T>(kVoxelHalf + 1);
  if (!(fabs(voxel[0]) <= limit && fabs(voxel[1]) <= limit && fabs(voxel[2]) <= limit)) return false;
  if (class_id < 0 || class_id >= table.num_classes) return false;
  int64_t index[3];
  for (int axis = 0; axis < 3; ++axis) index[axis] = static_cast<int64_t>(voxel[axis]) + kVoxelShift;
  const uint64_t bits =
      brick_bits(table, table.classes[class_id], brick_key(index[0] >> 2, index[1] >> 2, index[2] >> 2));
  return bits >> (16 * (index[0] & 3) + 4 * (index[1] & 3) + (index[2] & 3)) & 1;
}

// The voxels that a box reaches, from floats `low` to `high`. Returns whether they are at most 4 along each axis and
// near enough to be looked up; else `from` and `n` are not set.
template <class T>
inline bool small_box(const T* low, const T* high, int64_t* from, int* n) {
  const T limit = static_cast<T>(kVoxelHalf + 1);
  for (int axis = 0; axis < 3; ++axis) {
    if (!(high[axis] - low[axis] <= 3 && fabs(low[axis]) <= limit)) return false;  // false for NaN
    from[axis] = static_cast<int64_t>(low[axis]);
    n[axis] = static_cast<int>(high[axis] - low[axis]) + 1;
  }
  return true;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
