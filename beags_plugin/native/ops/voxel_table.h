// Stores a set of voxels for each class, as bricks of 4 x 4 x 4 voxels with a bit for each: one read covers 64 voxels.
// A small bounding box becomes an array of bricks, a large one a hash table, whose memory is linear in the occupied
// voxels. Kernels of every instruction set and of GPUs share the inlined queries; hence the namespace BEAGS_ISA.
#pragma once

#include <math.h>
#include <stdint.h>

#include "ops/hash.h"
#include "simd/device.h"

namespace beags {
namespace ops {

constexpr int64_t kVoxelHalf = int64_t(1) << 20;  // occupied voxels lie in -kVoxelHalf .. kVoxelHalf - 1
constexpr int64_t kVoxelShift = kVoxelHalf + 8;   // added to an index before it is split into brick and place
constexpr int kLargestCube = 3;                   // see VoxelLookup
constexpr uint64_t kNoBrick = ~uint64_t(0);       // key of an empty slot; bricks use 60 bits

struct Brick {
  uint64_t key, bits;  // bit 16 x + 4 y + z
};

// The slots of one class: 2^(64 - shift) of them, from `first` on.
struct BrickRange {
  uint64_t first, mask;
  int shift;
};

struct VoxelTable {
  int32_t num_classes;
  // The array [num_classes, size[0], size[1], size[2]] of bits, or null. Its first brick is `base`; along each axis its
  // first two and last two bricks are empty, so that voxels outside can be moved there.
  const uint64_t* dense;
  int32_t base[3], size[3];
  // The hash table, where there is no array.
  const Brick* bricks;
  const BrickRange* classes;
};

namespace BEAGS_ISA {

// Brick coordinates in 0 .. 2^20 - 1.
BEAGS_HD inline uint64_t brick_key(int64_t x, int64_t y, int64_t z) {
  return static_cast<uint64_t>(x) << 40 | static_cast<uint64_t>(y) << 20 | static_cast<uint64_t>(z);
}

BEAGS_HD inline uint64_t hashed_bits(const VoxelTable& table, int32_t class_id, int64_t x, int64_t y, int64_t z) {
  const BrickRange& range = table.classes[class_id];
  const uint64_t key = brick_key(x, y, z);
  for (uint64_t at = key * kGolden >> range.shift;; at = (at + 1) & range.mask) {
    const Brick& brick = table.bricks[range.first + at];
    if (brick.key == key) return brick.bits;
    if (brick.key == kNoBrick) return 0;
  }
}

// Returns the place of a brick along one axis of the array. last: the largest that is allowed.
BEAGS_HD inline int64_t dense_place(const VoxelTable& table, int axis, int64_t brick, int64_t last) {
  const int64_t at = brick - table.base[axis];
  return at < 0 ? 0 : at > last ? last : at;
}

BEAGS_HD inline uint64_t brick_bits(const VoxelTable& table, int32_t class_id, int64_t x, int64_t y, int64_t z) {
  if (!table.dense) return hashed_bits(table, class_id, x, y, z);
  const int64_t i = dense_place(table, 0, x, table.size[0] - 1), j = dense_place(table, 1, y, table.size[1] - 1),
                k = dense_place(table, 2, z, table.size[2] - 1);
  return table.dense[((class_id * static_cast<int64_t>(table.size[0]) + i) * table.size[1] + j) * table.size[2] + k];
}

// Repeat four bits in each of 16 rows, or 16 bits in each of 4 slices.
BEAGS_HD inline uint64_t in_rows(uint64_t bits) { return bits * 0x1111111111111111u; }
BEAGS_HD inline uint64_t in_slices(uint64_t bits) { return bits * 0x0001000100010001u; }

// Returns the bits of the box of sizes 1..4 whose corner is voxel 0.
BEAGS_HD inline uint64_t box_bits(int nx, int ny, int nz) {
  const uint64_t row = (1u << nz) - 1, slice = row * 0x1111u & ((uint64_t(1) << 4 * ny) - 1);
  return nx == 4 ? in_slices(slice) : in_slices(slice) & ((uint64_t(1) << 16 * nx) - 1);
}

// Returns the voxels of the box of sizes n[] in 1..4 whose corner is voxel low[], |low| <= kVoxelHalf + 2: bit 16 x + 4
// y + z is the voxel low + (x, y, z). Other bits may be set.
BEAGS_HD inline uint64_t voxel_box(const VoxelTable& table, int32_t class_id, const int64_t* low, const int* n) {
  if (class_id < 0 || class_id >= table.num_classes) return 0;
  int64_t brick[3];
  int place[3];
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t index = low[axis] + kVoxelShift;
    brick[axis] = index >> 2;
    place[axis] = static_cast<int>(index & 3);
  }
  uint64_t b[2][2][2];
  if (table.dense) {
    for (int axis = 0; axis < 3; ++axis) brick[axis] = dense_place(table, axis, brick[axis], table.size[axis] - 2);
    const int64_t step_y = table.size[2], step_x = step_y * table.size[1];
    const uint64_t* from = table.dense + (class_id * static_cast<int64_t>(table.size[0]) + brick[0]) * step_x +
                           brick[1] * step_y + brick[2];
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 2; ++j) {
        for (int k = 0; k < 2; ++k) b[i][j][k] = from[i * step_x + j * step_y + k];
      }
    }
  } else {
    for (int i = 0; i < 2; ++i) {
      for (int j = 0; j < 2; ++j) {
        for (int k = 0; k < 2; ++k) {
          const bool needed = (!i || place[0] + n[0] > 4) && (!j || place[1] + n[1] > 4) && (!k || place[2] + n[2] > 4);
          b[i][j][k] = needed ? hashed_bits(table, class_id, brick[0] + i, brick[1] + j, brick[2] + k) : 0;
        }
      }
    }
  }
  // Move voxel `place` to voxel 0 along each axis: of a brick's rows of 4, the first 4 - place come from the nearer
  // brick, the others from the farther one.
  const uint64_t cells = in_rows(0xFu >> place[2]), rows = in_slices(0xFFFFu >> 4 * place[1]);
  uint64_t slab[2];
  for (int i = 0; i < 2; ++i) {
    uint64_t column[2];
    for (int j = 0; j < 2; ++j) {
      column[j] = (b[i][j][0] >> place[2] & cells) | (b[i][j][1] << (4 - place[2]) & ~cells);
    }
    slab[i] = (column[0] >> 4 * place[1] & rows) | (column[1] << 4 * (4 - place[1]) & ~rows);
  }
  return slab[0] >> 16 * place[0] | slab[1] << 1 << (63 - 16 * place[0]);
}

constexpr int kWindow = 3;                      // bricks along each side of a window
constexpr int kWindowVoxels = 4 * kWindow - 3;  // A box of that side always lies in a window.

// Copies the bricks that the box of sizes n[] in 1 .. kWindowVoxels from voxel low[] on reaches, and moves low[] to the
// first voxel of the first one. Returns whether the box wholly lies in the set.
BEAGS_HD inline bool fill_window(const VoxelTable& table, int32_t class_id, int64_t* low, const int* n,
                                 uint64_t* window) {
  int64_t first[3];
  unsigned reached[3];  // bit 4 b + i: voxel i of brick b
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t index = low[axis] + kVoxelShift;
    first[axis] = index >> 2;
    low[axis] -= index & 3;
    reached[axis] = ((1u << n[axis]) - 1) << (index & 3);
  }
  uint64_t box[3][kWindow];  // the box's voxels, by their index along one axis
  for (int brick = 0; brick < kWindow; ++brick) {
    const auto bits = [&](int axis) { return static_cast<uint64_t>(reached[axis] >> 4 * brick & 0xF); };
    const uint64_t x = bits(0), y = bits(1), z = bits(2);
    box[0][brick] =
        (x & 1) * 0xFFFF | (x >> 1 & 1) * 0xFFFF0000 | (x >> 2 & 1) * (0xFFFFull << 32) | (x >> 3) * (0xFFFFull << 48);
    box[1][brick] = in_slices((y & 1) * 0xF | (y >> 1 & 1) * 0xF0 | (y >> 2 & 1) * 0xF00 | (y >> 3) * 0xF000);
    box[2][brick] = in_rows(z);
  }
  uint64_t missing = 0;
  if (table.dense) {
    int64_t place[3][kWindow];
    for (int brick = 0; brick < kWindow; ++brick) {
      for (int axis = 0; axis < 3; ++axis)
        place[axis][brick] = dense_place(table, axis, first[axis] + brick, table.size[axis] - 1);
    }
    for (int i = 0; i < kWindow; ++i) {
      for (int j = 0; j < kWindow; ++j) {
        const uint64_t* row =
            table.dense +
            ((class_id * static_cast<int64_t>(table.size[0]) + place[0][i]) * table.size[1] + place[1][j]) *
                table.size[2];
        for (int k = 0; k < kWindow; ++k) {
          const uint64_t bits = row[place[2][k]];
          *window++ = bits;
          missing |= box[0][i] & box[1][j] & box[2][k] & ~bits;
        }
      }
    }
    return missing == 0;
  }
  for (int i = 0; i < kWindow; ++i) {
    for (int j = 0; j < kWindow; ++j) {
      for (int k = 0; k < kWindow; ++k) {
        const uint64_t needed = box[0][i] & box[1][j] & box[2][k];
        const uint64_t bits = needed ? hashed_bits(table, class_id, first[0] + i, first[1] + j, first[2] + k) : 0;
        *window++ = bits;
        missing |= needed & ~bits;
      }
    }
  }
  return missing == 0;
}

// Returns whether a voxel is a member, |voxel| <= kVoxelHalf + 2.
BEAGS_HD inline bool voxel_bit(const VoxelTable& table, int32_t class_id, const int64_t* voxel) {
  if (class_id < 0 || class_id >= table.num_classes) return false;
  int64_t index[3];
  for (int axis = 0; axis < 3; ++axis) index[axis] = voxel[axis] + kVoxelShift;
  const uint64_t bits = brick_bits(table, class_id, index[0] >> 2, index[1] >> 2, index[2] >> 2);
  return bits >> (16 * (index[0] & 3) + 4 * (index[1] & 3) + (index[2] & 3)) & 1;
}

// Returns whether a voxel is a member. It is given as whole numbers in floating point, which need not be finite.
template <class T>
BEAGS_HD inline bool voxel_member(const VoxelTable& table, int32_t class_id, const T* voxel) {
  const T limit = static_cast<T>(kVoxelHalf + 1);
  if (!(fabs(voxel[0]) <= limit && fabs(voxel[1]) <= limit && fabs(voxel[2]) <= limit)) return false;
  const int64_t index[3] = {static_cast<int64_t>(voxel[0]), static_cast<int64_t>(voxel[1]),
                            static_cast<int64_t>(voxel[2])};
  return voxel_bit(table, class_id, index);
}

// Finds the voxels that a box reaches, from floats `low` to `high`. Returns whether they are at most 4 along each axis
// and near enough to be looked up; else `from` and `n` are not set.
template <class T>
BEAGS_HD inline bool small_box(const T* low, const T* high, int64_t* from, int* n) {
  const T limit = static_cast<T>(kVoxelHalf + 1);
  for (int axis = 0; axis < 3; ++axis) {
    if (!(high[axis] - low[axis] <= 3 && fabs(low[axis]) <= limit)) return false;  // The comparison is false for NaN.
    from[axis] = static_cast<int64_t>(low[axis]);
    n[axis] = static_cast<int>(high[axis] - low[axis]) + 1;
  }
  return true;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
