#include "cuda/ops/voxel_votes.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;

BEAGS_DEVICE uint64_t voxel_key(int64_t x, int64_t y, int64_t z) {
  return static_cast<uint64_t>(x) << 42 | static_cast<uint64_t>(y) << 21 | static_cast<uint64_t>(z);
}

// Returns the slot of a key; inserts a new key (then *fresh).
BEAGS_DEVICE int64_t claim(uint64_t* keys, int64_t slots, uint64_t key, bool* fresh) {
  *fresh = false;
  for (int64_t at = static_cast<int64_t>(hash_of(key) & (slots - 1));; at = (at + 1) & (slots - 1)) {
    uint64_t found = load_now(keys + at);  // A key that is set does not change.
    if (found == kEmptyKey) {
      found = atomicCAS(reinterpret_cast<unsigned long long*>(keys + at), static_cast<unsigned long long>(kEmptyKey),
                        static_cast<unsigned long long>(key));
      *fresh = found == kEmptyKey;
    }
    if (*fresh || found == key) return at;
  }
}

// Returns the slot of a voxel, or -1.
BEAGS_DEVICE int64_t find(const VoxelTally& tally, uint64_t key) {
  for (int64_t at = static_cast<int64_t>(hash_of(key) & (tally.slots - 1));; at = (at + 1) & (tally.slots - 1)) {
    if (tally.keys[at] == key) return at;
    if (tally.keys[at] == kEmptyKey) return -1;
  }
}

BEAGS_DEVICE void vote(const VoxelTally& tally, uint64_t key, int32_t label, uint32_t votes) {
  bool fresh;
  const int64_t slot = claim(tally.keys, tally.slots, key, &fresh);
  if (fresh) atomicAdd(tally.used, 1);
  const int32_t first = atomicCAS(tally.labels + slot, kNoLabel, label);
  if (first == kNoLabel || first == label) {
    atomicAdd(tally.votes + slot, votes);
    return;
  }
  const uint64_t pair = static_cast<uint64_t>(slot) << 32 | static_cast<uint32_t>(label);
  const int64_t more = claim(tally.more_keys, tally.more_slots, pair, &fresh);
  if (fresh) {
    atomicAdd(tally.used + 1, 1);
    tally.more_next[more] = atomicExch(tally.further + slot, static_cast<int32_t>(more));
  }
  atomicAdd(tally.more_votes + more, votes);
}

// Calls do_class(class, votes) for each class of a voxel.
template <class DoClass>
BEAGS_DEVICE void each_class(const VoxelTally& tally, int64_t slot, DoClass do_class) {
  do_class(tally.labels[slot], tally.votes[slot]);
  for (int32_t more = tally.further[slot]; more != kNoLabel; more = tally.more_next[more]) {
    do_class(static_cast<int32_t>(tally.more_keys[more] & 0xFFFFFFFFu), tally.more_votes[more]);
  }
}

template <class T>
__global__ void vote_pixels_kernel(VoxelTally tally, LiftedView<T> view, const int32_t* labels, int32_t ignore) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= static_cast<int64_t>(view.width) * view.height || labels[i] == ignore) return;
  T point[3], ray[3];
  if (!lift(view, static_cast<int>(i % view.width), static_cast<int>(i / view.width), point, ray)) return;
  int32_t v[3];
  for (int axis = 0; axis < 3; ++axis) v[axis] = floor_of(point[axis]) + kHalf;
  vote(tally, voxel_key(v[0], v[1], v[2]), labels[i], 1);
}

template <class T>
__global__ void vote_points_kernel(VoxelTally tally, const T* points, const int32_t* class_ids, int64_t count,
                                   VoxelFrame<T> frame) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  int64_t v[3];
  for (int axis = 0; axis < 3; ++axis) {
    const T scaled = floor((points[3 * i + axis] - frame.origin[axis]) / frame.size);
    if (!(fabs(scaled) < static_cast<T>(kHalf))) {  // This covers NaN too.
      atomicMax(tally.used + 2, 1);
      return;
    }
    v[axis] = static_cast<int64_t>(scaled) + kHalf;
  }
  vote(tally, voxel_key(v[0], v[1], v[2]), class_ids[i], 1);
}

__global__ void move_kernel(VoxelTally from, VoxelTally to) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < from.slots && from.keys[i] != kEmptyKey) vote(to, from.keys[i], from.labels[i], from.votes[i]);
  if (i < from.more_slots && from.more_keys[i] != kEmptyKey) {
    const uint64_t pair = from.more_keys[i];
    vote(to, from.keys[pair >> 32], static_cast<int32_t>(pair & 0xFFFFFFFFu), from.more_votes[i]);
  }
}

__global__ void decide_tally_kernel(VoxelTally tally) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= tally.slots || tally.keys[i] == kEmptyKey) return;
  uint32_t most = 0, total = 0;
  int32_t leader = kMixed;
  each_class(tally, i, [&](int32_t label, uint32_t votes) {
    total += votes;
    if (votes > most) {
      most = votes;
      leader = label;
    }
  });
  tally.leaders[i] = 2 * static_cast<uint64_t>(most) > total ? leader : kMixed;
  tally.totals[i] = total;
}

// Voxels with votes and their weights, around one point or several.
struct Poll {
  int64_t slots[24];
  uint32_t weights[24];
  int count;

  // Adds the eight voxels around a point. Returns the class that leads in all of them that have votes; kMixed if they
  // disagree or have none. *own: the slot of the voxel that holds the point, or -1.
  template <class T>
  BEAGS_DEVICE int32_t add(const VoxelTally& tally, const T* point, int64_t* own) {
    const NearVoxels near = about(point);
    int32_t inside[3], leader = kMixed;
    for (int axis = 0; axis < 3; ++axis) inside[axis] = floor_of(point[axis]) + kHalf;
    bool agreed = true;
    *own = -1;
    const int before = count;
    for (int i = 0; i < 8; ++i) {
      int64_t v[3];
      uint32_t weight = 1;
      bool is_own = true;
      for (int axis = 0; axis < 3; ++axis) {
        const int step = i >> (2 - axis) & 1;
        v[axis] = near.corner[axis] + step;
        weight *= static_cast<uint32_t>(step ? near.fraction[axis] : kParts - near.fraction[axis]);
        is_own = is_own && v[axis] == inside[axis];
      }
      const int64_t slot = find(tally, voxel_key(v[0], v[1], v[2]));
      if (slot < 0) continue;
      if (is_own) *own = slot;
      agreed = agreed && (count == before || tally.leaders[slot] == leader);
      leader = tally.leaders[slot];
      slots[count] = slot;
      weights[count++] = weight;
    }
    return agreed ? leader : kMixed;
  }

  BEAGS_DEVICE uint64_t votes_for(const VoxelTally& tally, int32_t label) const {
    uint64_t sum = 0;
    for (int i = 0; i < count; ++i) {
      each_class(tally, slots[i], [&](int32_t other, uint32_t votes) {
        if (other == label) sum += static_cast<uint64_t>(weights[i]) * votes;
      });
    }
    return sum;
  }

  // Returns the winner's share, 0 without votes. A tie keeps the label.
  BEAGS_DEVICE float decide(const VoxelTally& tally, int32_t* label) const {
    uint64_t most = 0, total = 0;
    int32_t winner = kNoLabel;
    bool alone = false;
    for (int i = 0; i < count; ++i) {
      each_class(tally, slots[i], [&](int32_t next, uint32_t votes) {
        total += static_cast<uint64_t>(weights[i]) * votes;
        if (next == winner) return;
        const uint64_t sum = votes_for(tally, next);
        if (sum > most) {
          most = sum;
          winner = next;
          alone = true;
        } else if (sum == most) {
          alone = false;
        }
      });
    }
    if (alone) *label = winner;
    return total ? static_cast<float>(most) / static_cast<float>(total) : 0.0f;
  }
};

// Returns the label's share of the votes of a voxel.
BEAGS_DEVICE float share_in(const VoxelTally& tally, int64_t slot, int32_t label) {
  float share = 0.0f;
  each_class(tally, slot, [&](int32_t other, uint32_t votes) {
    if (other == label) share = static_cast<float>(votes) / static_cast<float>(tally.totals[slot]);
  });
  return share;
}

template <class T>
__global__ void read_kernel(VoxelTally tally, LiftedView<T> view, int32_t* labels, float* confidence) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= static_cast<int64_t>(view.width) * view.height) return;
  confidence[i] = 0.0f;
  T point[3], ray[3];
  if (!lift(view, static_cast<int>(i % view.width), static_cast<int>(i / view.width), point, ray)) return;
  Poll poll;
  poll.count = 0;
  int64_t own;
  const int32_t leader = poll.add(tally, point, &own);
  if (leader != kMixed && own >= 0) {  // More than half of each voxel's votes is more than half of any weighted sum.
    labels[i] = leader;
    confidence[i] = share_in(tally, own, leader);
    return;
  }
  if (leader == kMixed) {
    for (int side = -kLook; side <= kLook; side += 2 * kLook) {
      const T step = static_cast<T>(side) * view.voxel;
      T moved[3];
      int64_t none;
      for (int axis = 0; axis < 3; ++axis) moved[axis] = point[axis] + step * ray[axis];
      poll.add(tally, moved, &none);
    }
  }
  int32_t label = labels[i];
  const float share = poll.decide(tally, &label);
  labels[i] = label;
  confidence[i] = own >= 0 ? share_in(tally, own, label) : share;
}

int64_t pixels_of(int height, int width) { return static_cast<int64_t>(height) * width; }

}  // namespace

template <class T>
void vote_pixels(const VoxelTally& tally, const LiftedView<T>& view, const int32_t* labels, int32_t ignore,
                 Stream stream) {
  const auto kernel = vote_pixels_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(pixels_of(view.height, view.width)), kBlockThreads, stream, tally, view, labels,
               ignore);
}

template <class T>
void vote_points(const VoxelTally& tally, const T* points, const int32_t* class_ids, int64_t count,
                 const VoxelFrame<T>& frame, Stream stream) {
  const auto kernel = vote_points_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(count), kBlockThreads, stream, tally, points, class_ids, count, frame);
}

void move_votes(const VoxelTally& from, const VoxelTally& to, Stream stream) {
  BEAGS_LAUNCH(move_kernel, blocks_for(std::max(from.slots, from.more_slots)), kBlockThreads, stream, from, to);
}

void decide(const VoxelTally& tally, Stream stream) {
  BEAGS_LAUNCH(decide_tally_kernel, blocks_for(tally.slots), kBlockThreads, stream, tally);
}

template <class T>
void read_votes(const VoxelTally& tally, const LiftedView<T>& view, int32_t* labels, float* confidence, Stream stream) {
  const auto kernel = read_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(pixels_of(view.height, view.width)), kBlockThreads, stream, tally, view, labels,
               confidence);
}

#define BEAGS_INSTANTIATE(T)                                                                                     \
  template void vote_pixels(const VoxelTally&, const LiftedView<T>&, const int32_t*, int32_t, Stream);           \
  template void vote_points(const VoxelTally&, const T*, const int32_t*, int64_t, const VoxelFrame<T>&, Stream); \
  template void read_votes(const VoxelTally&, const LiftedView<T>&, int32_t*, float*, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
