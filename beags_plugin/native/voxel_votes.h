// Votes for classes, pooled per voxel of the points that cast them (method, section 2).
#pragma once

#include <cstdint>
#include <vector>

namespace beags {
namespace ops {

class VoxelVotes {
 public:
  // origin: [3], corner of voxel (0, 0, 0); world units.
  VoxelVotes(const double* origin, double voxel_size, int threads);

  // One vote of each point [count, 3] for its label, which may be any number of 0 or more.
  template <class T>
  void add(int64_t count, const T* points, const int32_t* labels);
  // Counts are complete: finds every voxel's winner.
  void decide();
  // Per point, after `decide`: the winner of its voxel (`labels` is left where several lead or nobody voted) and the
  // share of its votes.
  template <class T>
  void read(int64_t count, const T* points, int32_t* labels, float* confidence) const;

 private:
  struct Count {
    uint64_t key;
    int32_t label;
    uint32_t votes;  // 0: empty
  };
  struct Winner {
    uint64_t key;
    int32_t label, leaders;
    uint32_t most, total;  // 0: empty
  };
  // Hash tables of one share of the voxels; a thread works on one share at a time.
  struct Share {
    std::vector<Count> counts;
    std::vector<Winner> winners;
    int64_t used = 0;
    void vote(uint64_t key, int32_t label);
    void grow();
    void decide();
    const Winner* find(uint64_t key) const;
  };
  template <class T>
  uint64_t key(const T* point) const;

  double origin_[3], voxel_size_;
  int threads_;
  std::vector<Share> shares_;
  std::vector<uint64_t> keys_;
};

}  // namespace ops
}  // namespace beags
