// Pools votes for classes per voxel of the points that cast them, and reads them back interpolated (method, section 2).
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "ops/lifted_view.h"

namespace beags {
namespace ops {

class VoxelVotes {
 public:
  explicit VoxelVotes(int threads);
  VoxelVotes(const VoxelVotes&) = delete;

  // Adds one vote for each pixel with a depth, for its label [height, width], 0 or more, unless that is `ignore`.
  template <class T>
  void add(const LiftedView<T>& view, const int32_t* labels, int32_t ignore);
  // Ends the counting.
  void decide();
  // Sets, after `decide`, the winner of the votes around each pixel with a depth, and its share; a tie or no vote keeps
  // the label.
  template <class T>
  void read(const LiftedView<T>& view, int32_t* labels, float* confidence) const;

 private:
  static constexpr int kCells = 64;                   // a brick is 4 x 4 x 4 voxels
  static constexpr int32_t kNobody = -2, kMany = -1;  // values in place of a leading class

  // While counting: one class and its votes; 0 votes: an empty voxel. Further classes are `Extra`s. After `decide`:
  // label has more than half of the votes, or is -1; with several classes, votes is kSeveral and the place of their
  // `Pair`s.
  struct Voxel {
    int32_t label;
    uint32_t votes;
  };
  static constexpr uint32_t kSeveral = 1u << 31;
  struct Extra {
    uint64_t voxel;  // place of the brick * 64 + cell
    int32_t label;
    uint32_t votes;  // 0: empty
  };
  struct Pair {  // one class of a voxel; before a voxel's pairs: their number, and all votes
    int32_t label;
    uint32_t votes;
  };
  struct alignas(64) Brick {
    // After `decide`, a bit for each voxel: whether the class `label` has more than half of its votes, and of those of
    // every voxel with votes among the eight around a point in it. The index is the eighth of the voxel that holds the
    // point (bits 4, 2, 1: the upper half along x, y, z).
    uint64_t agreed[8] = {};
    uint64_t pure = 0;   // voxels with votes for `label` alone
    uint64_t voted = 0;  // voxels with votes
    uint64_t led = 0;    // voxels with more than half of the votes for `label`
    int32_t label = 0;
    std::unique_ptr<Voxel[]> voxels;  // [64], x slowest
    const Pair* pairs = nullptr;      // pairs of its share; set by `decide`
  };
  struct Slot {
    uint64_t key;
    int32_t brick;  // -1: empty
  };
  // One share of the bricks; a thread works on one share at a time.
  struct Share {
    std::vector<Slot> slots;
    std::vector<Brick> bricks;
    std::vector<Extra> extras;
    std::vector<Pair> pairs;
    int64_t extras_used = 0;
    int32_t place(uint64_t key);
    const Brick* find(uint64_t key, uint64_t place) const;
    void vote(Voxel& voxel, int32_t brick, int cell, int32_t label);
    void vote_extra(uint64_t voxel, int32_t label);
    void grow_slots();
    void grow_extras();
    void decide();
    void summarise(Brick& brick) const;
  };
  class Reader;
  const Brick* find(uint64_t key) const;
  void fetch(uint64_t key) const;  // prefetches what `find` reads first
  void settle(uint64_t key, Brick& brick) const;

  int threads_;
  std::vector<Share> shares_;
  std::vector<uint64_t> keys_;
  std::vector<int32_t> labels_;
};

// Returns about one in `part`, a power of two, of the bricks of 4 x 4 x 4 voxels that hold the view's points: x, y, z
// of each, sorted. All views choose the same bricks.
template <class T>
std::vector<int32_t> brick_sample(const LiftedView<T>& view, uint32_t part);

}  // namespace ops
}  // namespace beags
