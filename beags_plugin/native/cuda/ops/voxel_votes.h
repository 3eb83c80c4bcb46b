// Counts votes per voxel and class in device memory. One open hash table holds the voxels, each with one class and its
// votes; another holds further classes, as a list for each voxel. Which class comes first in a voxel is random. The
// result is not: it is made of whole numbers, whose sums do not depend on their order.
#pragma once

#include "cuda/platform.h"
#include "ops/lifted_view.h"

namespace beags {
namespace cuda {

// The caller owns all memory. The number of slots is a power of two; a table is at most half full.
struct VoxelTally {
  int64_t slots, more_slots;
  uint64_t* keys;        // [slots] 21 bits for each axis, or kEmptyKey
  int32_t* labels;       // [slots] the voxel's first class; kNoLabel: none yet
  uint32_t* votes;       // [slots] votes of that class
  int32_t* further;      // [slots] place of the voxel's next class in the further table; kNoLabel: none
  uint64_t* more_keys;   // [more_slots] the voxel's slot << 32 | class, or kEmptyKey
  uint32_t* more_votes;  // [more_slots]
  int32_t* more_next;    // [more_slots] next place, as in `further`
  int32_t* used;         // [3] voxels; further classes; 1 if a point was too far away for a voxel
  // After `decide`, [slots]: the class with more than half of the votes, or kMixed; all votes.
  int32_t* leaders;
  uint32_t* totals;
};

constexpr uint64_t kEmptyKey = ~uint64_t(0);  // fill_bytes makes it with 0xFF, and also kNoLabel.
constexpr int32_t kNoLabel = -1, kMixed = -1;

// Adds one vote for each pixel with a depth, for its label, 0 or more, unless that is `ignore`.
template <class T>
void vote_pixels(const VoxelTally& tally, const ops::LiftedView<T>& view, const int32_t* labels, int32_t ignore,
                 Stream stream);
// The grid of voxels: a point lies in voxel floor((point - origin) / size), as in VisibilityGrid.
template <class T>
struct VoxelFrame {
  T origin[3], size;
};
// Adds one vote for each point [count, 3], for its class [count].
template <class T>
void vote_points(const VoxelTally& tally, const T* points, const int32_t* class_ids, int64_t count,
                 const VoxelFrame<T>& frame, Stream stream);
// Moves all votes of `from` into an empty tally.
void move_votes(const VoxelTally& from, const VoxelTally& to, Stream stream);
void decide(const VoxelTally& tally, Stream stream);
// See VoxelVotes::read.
template <class T>
void read_votes(const VoxelTally& tally, const ops::LiftedView<T>& view, int32_t* labels, float* confidence,
                Stream stream);

}  // namespace cuda
}  // namespace beags
