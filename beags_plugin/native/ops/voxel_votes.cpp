#include "ops/voxel_votes.h"

#include <algorithm>
#include <array>

#include "ops/voxel_space.h"

namespace beags {
namespace ops {
namespace {

constexpr uint64_t kNowhere = ~uint64_t(0);  // key of pixels without a depth, or too far away
constexpr int kShares = 64;
constexpr int kBlock = 64;                                       // voxels that are fetched at a time
constexpr uint32_t kPrimes[3] = {73856093, 19349663, 83492791};  // the same numbers as in masks/spatial_chunks.py

// Combines three bricks in a row along an axis into bits of the middle one: a bit is set if it is set there, or in the
// next voxel below or above.
void with_next(int axis, const uint64_t* bricks, uint64_t* below, uint64_t* above) {
  const uint64_t first = kPlane[axis], last = first << 3 * kShift[axis], own = bricks[1];
  const int shift = kShift[axis];
  *below = own | (own & ~last) << shift | (bricks[0] & last) >> 3 * shift;
  *above = own | (own & ~first) >> shift | (bricks[2] & first) << 3 * shift;
}

}  // namespace

VoxelVotes::VoxelVotes(int threads) : threads_(threads), shares_(kShares) {}

template <class T>
void VoxelVotes::add(const LiftedView<T>& view, const int32_t* labels, int32_t ignore) {
  const int64_t count = static_cast<int64_t>(view.height) * view.width;
  keys_.resize(count);
  labels_.resize(count);
  const int rows = tile_rows(view);
  const int team = count < 4000 ? 1 : threads_;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int row = 0; row < rows; ++row) {
    int64_t place = static_cast<int64_t>(row) * kTile * view.width;
    each_tile(view, row, [&](int left, int right, int top, int bottom) {
      const LiftedTile<T> tile(view, left, right, top, bottom);
      for (int y = top; y < bottom; ++y) {
        for (int x = left; x < right; ++x) {
          const int32_t label = labels[static_cast<int64_t>(y) * view.width + x];
          const int i = (y - top) * kTile + x - left;
          uint64_t& key = keys_[place];
          labels_[place++] = label;
          key = kNowhere;
          if (label == ignore || !tile.near[i]) continue;
          int32_t v[3];
          for (int a = 0; a < 3; ++a) v[a] = tile.voxel[a][i] + kHalf;
          key = brick_key(v[0] >> 2, v[1] >> 2, v[2] >> 2) << 6 | cell_of(v[0], v[1], v[2]);
        }
      }
    });
  }
  // Every thread reads all keys and counts those of its own shares: no two threads write to one table.
#pragma omp parallel for num_threads(team) schedule(static, 1)
  for (int part = 0; part < team; ++part) {
    const uint64_t first = kShares * part / team, last = kShares * (part + 1) / team;
    struct Kept {
      uint64_t key = kNowhere;
      Share* share = nullptr;  // null: it belongs to another thread
      Voxel* voxels = nullptr;
      int32_t brick = 0;
    };
    std::vector<Kept> kept(kKept);
    struct Vote {
      Share* share;
      Voxel* voxel;
      int32_t brick, label, cell;
    } votes[kBlock];
    for (int64_t first_key = 0; first_key < count; first_key += kBlock) {
      const int64_t end = std::min(first_key + kBlock, count);
      int ready = 0;
      for (int64_t i = first_key; i < end; ++i) {
        if (keys_[i] == kNowhere) continue;
        const uint64_t key = keys_[i] >> 6;
        Kept& at = kept[kept_at(key)];
        if (at.key != key) {
          const uint64_t number = place_of(key) >> 58;
          at = {key};
          if (number >= first && number < last) {
            at.share = &shares_[number];
            at.brick = at.share->place(key);
            at.voxels = at.share->bricks[at.brick].voxels.get();
          }
        }
        if (!at.share) continue;
        const int32_t cell = static_cast<int32_t>(keys_[i] & 63);
        votes[ready] = {at.share, at.voxels + cell, at.brick, labels_[i], cell};
        __builtin_prefetch(votes[ready++].voxel, 1);
      }
      for (int k = 0; k < ready; ++k)
        votes[k].share->vote(*votes[k].voxel, votes[k].brick, votes[k].cell, votes[k].label);
    }
  }
}

int32_t VoxelVotes::Share::place(uint64_t key) {
  if (2 * (bricks.size() + 1) > slots.size()) grow_slots();
  const uint64_t mask = slots.size() - 1;
  uint64_t at = place_of(key) & mask;
  while (slots[at].brick >= 0 && slots[at].key != key) at = (at + kNextPlace) & mask;
  if (slots[at].brick < 0) {
    slots[at] = {key, static_cast<int32_t>(bricks.size())};
    bricks.emplace_back();
    bricks.back().voxels = std::make_unique<Voxel[]>(kCells);
  }
  return slots[at].brick;
}

void VoxelVotes::Share::grow_slots() {
  std::vector<Slot> larger(std::max<size_t>(64, 2 * slots.size()), Slot{0, -1});
  const uint64_t mask = larger.size() - 1;
  for (const Slot& slot : slots) {
    if (slot.brick < 0) continue;
    uint64_t at = place_of(slot.key) & mask;
    while (larger[at].brick >= 0) at = (at + kNextPlace) & mask;
    larger[at] = slot;
  }
  slots.swap(larger);
}

const VoxelVotes::Brick* VoxelVotes::Share::find(uint64_t key, uint64_t place) const {
  if (slots.empty()) return nullptr;
  const uint64_t mask = slots.size() - 1;
  for (uint64_t at = place & mask; slots[at].brick >= 0; at = (at + kNextPlace) & mask) {
    if (slots[at].key == key) return &bricks[slots[at].brick];
  }
  return nullptr;
}

void VoxelVotes::Share::vote(Voxel& voxel, int32_t brick, int cell, int32_t label) {
  if (voxel.votes == 0) voxel.label = label;
  if (voxel.label == label) {
    ++voxel.votes;
  } else {
    vote_extra(static_cast<uint64_t>(brick) * kCells + cell, label);
  }
}

void VoxelVotes::Share::vote_extra(uint64_t voxel, int32_t label) {
  if (2 * (extras_used + 1) > static_cast<int64_t>(extras.size())) grow_extras();
  const uint64_t mask = extras.size() - 1;
  uint64_t at = hash_of(voxel + kGolden * static_cast<uint64_t>(label)) & mask;
  while (extras[at].votes && !(extras[at].voxel == voxel && extras[at].label == label)) at = (at + 1) & mask;
  if (extras[at].votes == 0) {
    extras[at] = {voxel, label, 0};
    ++extras_used;
  }
  ++extras[at].votes;
}

void VoxelVotes::Share::grow_extras() {
  std::vector<Extra> larger(std::max<size_t>(64, 2 * extras.size()), Extra{0, 0, 0});
  const uint64_t mask = larger.size() - 1;
  for (const Extra& extra : extras) {
    if (extra.votes == 0) continue;
    uint64_t at = hash_of(extra.voxel + kGolden * static_cast<uint64_t>(extra.label)) & mask;
    while (larger[at].votes) at = (at + 1) & mask;
    larger[at] = extra;
  }
  extras.swap(larger);
}

void VoxelVotes::Share::decide() {
  extras.erase(std::remove_if(extras.begin(), extras.end(), [](const Extra& e) { return e.votes == 0; }), extras.end());
  std::sort(extras.begin(), extras.end(), [](const Extra& a, const Extra& b) { return a.voxel < b.voxel; });
  for (size_t i = 0; i < extras.size();) {
    Voxel& voxel = bricks[extras[i].voxel / kCells].voxels[extras[i].voxel % kCells];
    const size_t first = pairs.size();
    Pair most{voxel.label, voxel.votes};
    uint32_t total = voxel.votes;
    pairs.insert(pairs.end(), {Pair{0, 0}, most});
    for (const uint64_t same = extras[i].voxel; i < extras.size() && extras[i].voxel == same; ++i) {
      pairs.push_back({extras[i].label, extras[i].votes});
      total += extras[i].votes;
      if (extras[i].votes > most.votes) {
        most = pairs.back();
        std::swap(pairs.back(), pairs[first + 1]);  // It is the first to be read.
      }
    }
    pairs[first] = {static_cast<int32_t>(pairs.size() - first - 1), total};
    const bool leads = 2 * uint64_t(most.votes) > total;
    voxel = {leads ? most.label : kMany, kSeveral | static_cast<uint32_t>(first)};
  }
  std::vector<Extra>().swap(extras);
  for (Brick& brick : bricks) {
    brick.pairs = pairs.data();
    summarise(brick);
  }
}

void VoxelVotes::decide() {
  std::vector<uint64_t>().swap(keys_);
  std::vector<int32_t>().swap(labels_);
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
  for (int share = 0; share < kShares; ++share) shares_[share].decide();
#pragma omp parallel for num_threads(threads_) schedule(dynamic, 1)
  for (int share = 0; share < kShares; ++share) {
    for (const Slot& slot : shares_[share].slots) {
      if (slot.brick >= 0) settle(slot.key, shares_[share].bricks[slot.brick]);
    }
  }
}

void VoxelVotes::Share::summarise(Brick& brick) const {
  int ahead = 0;  // `label` becomes the class that leads in most voxels, if that is more than half of them
  for (int cell = 0; cell < kCells; ++cell) {
    const Voxel& voxel = brick.voxels[cell];
    if (voxel.votes == 0) continue;
    brick.voted |= uint64_t(1) << cell;
    if (voxel.label < 0) continue;
    if (ahead == 0) brick.label = voxel.label;
    ahead += voxel.label == brick.label ? 1 : -1;
  }
  for (int cell = 0; cell < kCells; ++cell) {
    const Voxel& voxel = brick.voxels[cell];
    if (voxel.votes == 0 || voxel.label != brick.label) continue;
    brick.led |= uint64_t(1) << cell;
    if (!(voxel.votes & kSeveral)) brick.pure |= uint64_t(1) << cell;
  }
}

const VoxelVotes::Brick* VoxelVotes::find(uint64_t key) const {
  const uint64_t place = place_of(key);
  return shares_[place >> 58].find(key, place);
}

void VoxelVotes::fetch(uint64_t key) const {
  const uint64_t place = place_of(key);
  const std::vector<Slot>& slots = shares_[place >> 58].slots;
  if (!slots.empty()) __builtin_prefetch(&slots[place & (slots.size() - 1)]);
}

void VoxelVotes::settle(uint64_t key, Brick& brick) const {
  if (!brick.led) return;
  uint64_t against[27] = {};  // voxels of the surrounding bricks that disagree
  for (int side = 0; side < 27; ++side) {
    const int step[3] = {side / 9 - 1, side / 3 % 3 - 1, side % 3 - 1};
    uint64_t touched = brick.led;
    for (int axis = 0; axis < 3; ++axis) {
      if (step[axis]) touched &= step[axis] > 0 ? kPlane[axis] << 3 * kShift[axis] : kPlane[axis];
    }
    if (!touched) continue;
    // Adding to a key is safe: no coordinate is near enough to its end to carry.
    const Brick* other = side == 13 ? &brick
                                    : find(key + (static_cast<uint64_t>(static_cast<int64_t>(step[0])) << 38) +
                                           (static_cast<uint64_t>(static_cast<int64_t>(step[1])) << 19) +
                                           static_cast<uint64_t>(static_cast<int64_t>(step[2])));
    if (other) against[side] = other->label == brick.label ? other->voted & ~other->led : other->voted;
  }
  // Axis by axis, combines the bits of a voxel and of the next one, below ([0]) and above ([1]).
  uint64_t by_z[2][9], by_yz[2][2][3];
  for (int i = 0; i < 9; ++i) with_next(2, against + 3 * i, &by_z[0][i], &by_z[1][i]);
  for (int z = 0; z < 2; ++z) {
    for (int i = 0; i < 3; ++i) with_next(1, by_z[z] + 3 * i, &by_yz[0][z][i], &by_yz[1][z][i]);
  }
  for (int y = 0; y < 2; ++y) {
    for (int z = 0; z < 2; ++z) {
      uint64_t below, above;
      with_next(0, by_yz[y][z], &below, &above);
      brick.agreed[y << 1 | z] = brick.led & ~below;
      brick.agreed[4 | y << 1 | z] = brick.led & ~above;
    }
  }
}

template <class T>
std::vector<int32_t> brick_sample(const LiftedView<T>& view, uint32_t part) {
  std::vector<std::array<int32_t, 3>> found;
  for (int row = 0; row < tile_rows(view); ++row) {
    each_tile(view, row, [&](int left, int right, int top, int bottom) {
      const LiftedTile<T> tile(view, left, right, top, bottom);
      uint32_t hash[LiftedTile<T>::kPlaces] = {};
      for (int a = 0; a < 3; ++a) {
        for (int i = 0; i < tile.kPlaces; ++i) hash[i] ^= static_cast<uint32_t>(tile.voxel[a][i] >> 2) * kPrimes[a];
      }
      for (int i = 0; i < tile.kPlaces; ++i) {
        if ((hash[i] >> 8 & (part - 1)) || !tile.near[i]) continue;
        const std::array<int32_t, 3> brick = {tile.voxel[0][i] >> 2, tile.voxel[1][i] >> 2, tile.voxel[2][i] >> 2};
        if (found.empty() || found.back() != brick) found.push_back(brick);
      }
    });
  }
  std::sort(found.begin(), found.end());
  found.erase(std::unique(found.begin(), found.end()), found.end());
  std::vector<int32_t> flat;
  for (const auto& brick : found) flat.insert(flat.end(), brick.begin(), brick.end());
  return flat;
}

template std::vector<int32_t> brick_sample(const LiftedView<float>&, uint32_t);
template std::vector<int32_t> brick_sample(const LiftedView<double>&, uint32_t);
template void VoxelVotes::add(const LiftedView<float>&, const int32_t*, int32_t);
template void VoxelVotes::add(const LiftedView<double>&, const int32_t*, int32_t);

}  // namespace ops
}  // namespace beags
