// Looks up points in the visibility voxel grids: two sets of bricks hold the occupied voxels, and the valid ones next
// to an occupied one (method, section 5). They are built once; queries are safe from any thread.
#pragma once

#include <array>
#include <vector>

#ifndef BEAGS_ISA
#define BEAGS_ISA baseline
#endif
#include "ops/voxel_table.h"

namespace beags {
namespace ops {

class VoxelLookup {
 public:
  // Storage of one VoxelTable.
  struct Bricks {
    std::vector<uint64_t> dense;
    int32_t base[3], size[3];
    std::vector<Brick> slots;
    std::vector<BrickRange> ranges;
    int32_t num_classes;
    // bricks: those of each class, all distinct.
    void store(const std::vector<std::vector<Brick>>& bricks);
    void hash(const std::vector<std::vector<Brick>>& bricks);
    VoxelTable table() const;
    int64_t bytes() const;
  };

  // keys: [count], 21 bits for each axis, as VisibilityGrid; classes: [count] in 0 .. num_classes - 1; origin: [3].
  VoxelLookup(const int64_t* keys, const int32_t* classes, int64_t count, int num_classes, const double* origin,
              double voxel_size);

  VoxelTable occupied() const { return occupied_.table(); }
  VoxelTable valid() const { return cubes_[0].table(); }
  // Returns the corners (of lowest indices) of cubes of valid voxels, 1, 2 and 3 along each side: one lookup
  // answers for a whole cube.
  std::array<VoxelTable, kLargestCube> valid_cubes() const;
  // Returns all tables: that of the occupied voxels, then those of `valid_cubes`.
  std::array<const Bricks*, 1 + kLargestCube> stored() const {
    return {&occupied_, &cubes_[0], &cubes_[1], &cubes_[2]};
  }
  const double* origin() const { return origin_; }
  double voxel_size() const { return voxel_size_; }
  int64_t bytes() const;

  // points: [count, 3]; class_ids: [count]. out: D_occ in 0..27.
  template <class T>
  void count_occupied(int64_t count, const T* points, const int32_t* class_ids, int64_t* out, int threads) const;
  // out: whether D_occ > 0.
  template <class T>
  void is_valid(int64_t count, const T* points, const int32_t* class_ids, bool* out, int threads) const;
  // means, axes_u, axes_v: [count, 3]. out: whether the disc surely lies in valid voxels.
  template <class T>
  void disc_inside(int64_t count, const T* means, const T* axes_u, const T* axes_v, const int32_t* class_ids, bool* out,
                   int threads) const;

 private:
  template <class T>
  void scaled(const T* point, T* voxel) const;

  Bricks occupied_, cubes_[kLargestCube];
  double origin_[3], voxel_size_;
};

}  // namespace ops
}  // namespace beags
