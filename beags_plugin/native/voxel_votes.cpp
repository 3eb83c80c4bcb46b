#include "voxel_votes.h"

#include <algorithm>
#include <cmath>

#include "golden.h"

namespace beags {
namespace ops {
namespace {

constexpr uint64_t kNowhere = ~uint64_t(0);  // points that are not finite or too far away
constexpr int64_t kHalf = int64_t(1) << 20;  // 21 bits along each axis
constexpr int kShares = 64;

uint64_t hash(uint64_t key) {
  key = (key ^ key >> 32) * kGolden;
  return key ^ key >> 29;
}
int share_of(uint64_t hash) { return static_cast<int>(hash >> 58); }

}  // namespace

VoxelVotes::VoxelVotes(const double* origin, double voxel_size, int threads)
    : voxel_size_(voxel_size), threads_(threads), shares_(kShares) {
  std::copy_n(origin, 3, origin_);
}

template <class T>
uint64_t VoxelVotes::key(const T* point) const {
  uint64_t key = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const T index = std::floor((point[axis] - static_cast<T>(origin_[axis])) / static_cast<T>(voxel_size_));
    if (!(std::abs(index) < static_cast<T>(kHalf))) return kNowhere;
    key = key << 21 | static_cast<uint64_t>(static_cast<int64_t>(index) + kHalf);
  }
  return key;
}

template <class T>
void VoxelVotes::add(int64_t count, const T* points, const int32_t* labels) {
  keys_.resize(count);
  const int team = count < 4000 ? 1 : threads_;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < count; ++i) keys_[i] = key(points + 3 * i);
  // Every thread reads all keys and counts those of its own shares: no two write to one table.
#pragma omp parallel for num_threads(team) schedule(static, 1)
  for (int part = 0; part < team; ++part) {
    const int first = kShares * part / team, last = kShares * (part + 1) / team;
    for (int64_t i = 0; i < count; ++i) {
      if (keys_[i] == kNowhere) continue;
      const int share = share_of(hash(keys_[i]));
      if (share >= first && share < last) shares_[share].vote(keys_[i], labels[i]);
    }
  }
}

void VoxelVotes::Share::vote(uint64_t key, int32_t label) {
  if (2 * (used + 1) > static_cast<int64_t>(counts.size())) grow();
  const uint64_t mask = counts.size() - 1;
  for (uint64_t at = hash(key + kGolden * static_cast<uint64_t>(label)) & mask;; at = (at + 1) & mask) {
    Count& slot = counts[at];
    if (slot.votes == 0) {
      slot = {key, label, 1};
      ++used;
      return;
    }
    if (slot.key == key && slot.label == label) {
      ++slot.votes;
      return;
    }
  }
}

void VoxelVotes::Share::grow() {
  std::vector<Count> larger(std::max<size_t>(256, 2 * counts.size()), Count{0, 0, 0});
  const uint64_t mask = larger.size() - 1;
  for (const Count& count : counts) {
    if (count.votes == 0) continue;
    uint64_t at = hash(count.key + kGolden * static_cast<uint64_t>(count.label)) & mask;
    while (larger[at].votes) at = (at + 1) & mask;
    larger[at] = count;
  }
  counts.swap(larger);
}

// Determinism: the result does not depend on the order in which a voxel's classes come.
void VoxelVotes::Share::decide() {
  size_t size = 16;
  while (size < 2 * static_cast<size_t>(used)) size *= 2;
  winners.assign(size, Winner{0, 0, 0, 0, 0});
  const uint64_t mask = size - 1;
  for (const Count& count : counts) {
    if (count.votes == 0) continue;
    uint64_t at = hash(count.key) & mask;
    while (winners[at].total && winners[at].key != count.key) at = (at + 1) & mask;
    Winner& winner = winners[at];
    winner.key = count.key;
    winner.total += count.votes;
    if (count.votes > winner.most) {
      winner.most = count.votes;
      winner.label = count.label;
      winner.leaders = 1;
    } else if (count.votes == winner.most) {
      ++winner.leaders;
    }
  }
  std::vector<Count>().swap(counts);
  used = 0;
}

void VoxelVotes::decide() {
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
  for (int share = 0; share < kShares; ++share) shares_[share].decide();
}

const VoxelVotes::Winner* VoxelVotes::Share::find(uint64_t key) const {
  const uint64_t mask = winners.size() - 1;
  for (uint64_t at = hash(key) & mask; winners[at].total; at = (at + 1) & mask) {
    if (winners[at].key == key) return &winners[at];
  }
  return nullptr;
}

template <class T>
void VoxelVotes::read(int64_t count, const T* points, int32_t* labels, float* confidence) const {
  const int team = count < 4000 ? 1 : threads_;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < count; ++i) {
    const uint64_t at = key(points + 3 * i);
    const Winner* winner = at == kNowhere ? nullptr : shares_[share_of(hash(at))].find(at);
    confidence[i] = winner ? static_cast<float>(winner->most) / static_cast<float>(winner->total) : 0.0f;
    if (winner && winner->leaders == 1) labels[i] = winner->label;
  }
}

#define BEAGS_INSTANTIATE(T)                                        \
  template void VoxelVotes::add(int64_t, const T*, const int32_t*); \
  template void VoxelVotes::read(int64_t, const T*, int32_t*, float*) const;
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace ops
}  // namespace beags
