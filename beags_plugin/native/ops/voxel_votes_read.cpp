#include <algorithm>

#include "ops/voxel_space.h"
#include "ops/voxel_votes.h"

namespace beags {
namespace ops {

// Reads the pixels of one tile after the other.
class VoxelVotes::Reader {
 public:
  explicit Reader(const VoxelVotes& votes) : votes_(votes), kept_(kKept) {}

  // Sets labels and confidence. The memory that the pixels of a tile read is prefetched together, so that they wait
  // once.
  template <class T>
  void read(const LiftedView<T>& view, int left, int right, int top, int bottom, int32_t* labels, float* confidence) {
    const LiftedTile<T> tile(view, left, right, top, bottom);
    Query<T> queries[kTile * kTile];
    int count = 0;
    for (int y = top; y < bottom; ++y) {
      for (int x = left; x < right; ++x) {
        Query<T>& query = queries[count];
        query.pixel = static_cast<int64_t>(y) * view.width + x;
        confidence[query.pixel] = 0.0f;
        const int place = (y - top) * kTile + x - left;
        if (!tile.near[place]) continue;
        ++count;
        locate(tile, place, query);
        if (kept_[kept_at(query.key)].key != query.key) votes_.fetch(query.key);
      }
    }
    for (int i = 0; i < count; ++i) {
      queries[i].brick = find(queries[i].key);
      __builtin_prefetch(queries[i].brick->agreed + queries[i].eighth);
      __builtin_prefetch(&queries[i].brick->pure);
    }
    int open[kTile * kTile], left_open = 0;
    for (int i = 0; i < count; ++i) {
      const Query<T>& query = queries[i];
      const Brick& at = *query.brick;
      // A class with more than half of the votes of each voxel has more than half of any weighted sum.
      if (at.agreed[query.eighth] & at.pure & uint64_t(1) << query.cell) {
        labels[query.pixel] = at.label;
        confidence[query.pixel] = 1.0f;
      } else {
        open[left_open++] = i;
        if (at.voxels) __builtin_prefetch(&at.voxels[query.cell]);
      }
    }
    for (int i = 0; i < left_open; ++i) {
      const Query<T>& query = queries[open[i]];
      confidence[query.pixel] = answer(view, query, labels + query.pixel);
    }
  }

 private:
  // A pixel's point, and the voxel and its eighth that hold the point.
  template <class T>
  struct Query {
    T point[3];
    int64_t pixel;
    uint64_t key;
    const Brick* brick;
    int cell, eighth;
  };

  template <class T>
  static void locate(const LiftedTile<T>& tile, int place, Query<T>& query) {
    int32_t own[3];
    query.eighth = 0;
    for (int a = 0; a < 3; ++a) {
      const T at = query.point[a] = tile.point[a][place];
      const int32_t whole = tile.voxel[a][place];
      own[a] = whole + kHalf;
      query.eighth = query.eighth << 1 | (floor_of(at - T(0.5)) == whole);
    }
    query.key = brick_key(own[0] >> 2, own[1] >> 2, own[2] >> 2);
    query.cell = cell_of(own[0], own[1], own[2]);
  }

  // Returns the pixel's confidence; sets its label.
  template <class T>
  float answer(const LiftedView<T>& view, const Query<T>& query, int32_t* label) {
    const Brick& at = *query.brick;
    const int cell = query.cell;
    if (at.agreed[query.eighth] >> cell & 1) {
      *label = at.label;
      return share_in(at.voxels[cell], at.pairs, at.label);
    }
    const bool voted = at.voted >> cell & 1;
    Look here;
    look_about(query.point, here);
    const int32_t leader = agreed(here);
    if (leader >= 0 && voted) {
      *label = leader;
      return share_in(at.voxels[cell], at.pairs, leader);
    }
    poll_.clear();
    if (leader < 0) {
      Look before, behind;
      look_along(view, query, -kLook, before);
      look_along(view, query, kLook, behind);
      count(before);
      count(behind);
    }
    count(here);
    const float share = decide(label);
    return voted ? share_in(at.voxels[cell], at.pairs, *label) : share;
  }

  struct Kept {
    uint64_t key = ~uint64_t(0);
    const Brick* brick = nullptr;
  };
  struct Entry {
    int32_t label;
    uint64_t votes;
  };

  // Eight voxels around a point, and their bricks, one to eight of them, by bits 4, 2, 1 for one step along x, y, z;
  // the other bricks are not read.
  struct Look {
    NearVoxels place;
    const Brick* bricks[8];
  };

  template <class T>
  void look_about(const T* point, Look& look) {
    look.place = about(point);
    int32_t near[3], end[3];
    for (int a = 0; a < 3; ++a) {
      near[a] = look.place.corner[a] >> 2;
      end[a] = (look.place.corner[a] + 1) >> 2;
    }
    for (int32_t x = near[0]; x <= end[0]; ++x) {
      for (int32_t y = near[1]; y <= end[1]; ++y) {
        for (int32_t z = near[2]; z <= end[2]; ++z) {
          look.bricks[(x - near[0]) << 2 | (y - near[1]) << 1 | (z - near[2])] = find(brick_key(x, y, z));
        }
      }
    }
  }

  // Moves that many steps along the pixel's ray. Its voxels are prefetched now and read later.
  template <class T>
  void look_along(const LiftedView<T>& view, const Query<T>& query, int steps, Look& look) {
    const T px = static_cast<T>(query.pixel % view.width) + T(0.5);
    const T py = static_cast<T>(query.pixel / view.width) + T(0.5);
    const T step = static_cast<T>(steps) * view.voxel;
    T moved[3];
    for (int a = 0; a < 3; ++a) moved[a] = query.point[a] + step * ray_of(view, a, px, py);
    look_about(moved, look);
    each_voxel(look, [](const Brick&, const Voxel& voxel, uint32_t) { __builtin_prefetch(&voxel); });
  }

  const Brick* find(uint64_t key) {
    Kept& kept = kept_[kept_at(key)];
    if (kept.key != key) {
      const Brick* brick = votes_.find(key);
      kept = {key, brick ? brick : &nothing_};
    }
    return kept.brick;
  }

  // Calls do_voxel(brick, voxel, weight) for each of the eight voxels that has votes.
  template <class DoVoxel>
  static void each_voxel(const Look& look, DoVoxel do_voxel) {
    const NearVoxels& place = look.place;
    int brick[3][2], cell[3][2];
    uint32_t weight[3][2];
    for (int a = 0; a < 3; ++a) {
      for (int step = 0; step < 2; ++step) {
        const int32_t voxel = place.corner[a] + step;
        brick[a][step] = (voxel >> 2 != place.corner[a] >> 2) << (2 - a);
        cell[a][step] = (voxel & 3) << (4 - 2 * a);
        weight[a][step] = step ? place.fraction[a] : kParts - place.fraction[a];
      }
    }
    for (int i = 0; i < 8; ++i) {
      const int x = i >> 2, y = i >> 1 & 1, z = i & 1;
      const Brick& at = *look.bricks[brick[0][x] | brick[1][y] | brick[2][z]];
      const int here = cell[0][x] | cell[1][y] | cell[2][z];
      if (at.voted >> here & 1) do_voxel(at, at.voxels[here], weight[0][x] * weight[1][y] * weight[2][z]);
    }
  }

  // Returns the class with more than half of the votes of each of the eight voxels that has any, or kMany or kNobody.
  static int32_t agreed(const Look& look) {
    int32_t least = INT32_MAX, most = kNobody;
    each_voxel(look, [&](const Brick&, const Voxel& voxel, uint32_t) {
      least = std::min(least, voxel.label);
      most = std::max(most, voxel.label);
    });
    return most == kNobody ? kNobody : least == most ? most : kMany;
  }

  // Adds the votes of the eight voxels, interpolated.
  void count(const Look& look) {
    each_voxel(look, [&](const Brick& at, const Voxel& voxel, uint64_t weight) {
      if (!(voxel.votes & kSeveral)) return add(voxel.label, weight * voxel.votes);
      const Pair* pair = at.pairs + (voxel.votes & ~kSeveral);
      for (int32_t k = 1; k <= pair->label; ++k) add(pair[k].label, weight * pair[k].votes);
    });
  }

  // Determinism: sums of whole numbers do not depend on their order.
  void add(int32_t label, uint64_t votes) {
    for (Entry& entry : poll_) {
      if (entry.label == label) {
        entry.votes += votes;
        return;
      }
    }
    poll_.push_back({label, votes});
  }

  // Returns the winner's share, 0 without votes. A tie keeps the label.
  float decide(int32_t* label) const {
    uint64_t most = 0, total = 0;
    int32_t winner = 0, leaders = 0;
    for (const Entry& entry : poll_) {
      total += entry.votes;
      if (entry.votes > most) {
        most = entry.votes;
        winner = entry.label;
        leaders = 1;
      } else if (entry.votes == most) {
        ++leaders;
      }
    }
    if (leaders == 1 && most) *label = winner;
    return total ? static_cast<float>(most) / static_cast<float>(total) : 0.0f;
  }

  // Returns the label's share of the votes of a voxel that has some.
  static float share_in(const Voxel& voxel, const Pair* pairs, int32_t label) {
    if (!(voxel.votes & kSeveral)) return voxel.label == label ? 1.0f : 0.0f;
    const Pair* pair = pairs + (voxel.votes & ~kSeveral);
    for (int32_t k = 1; k <= pair->label; ++k) {
      if (pair[k].label == label) return static_cast<float>(pair[k].votes) / static_cast<float>(pair->votes);
    }
    return 0.0f;
  }

  const VoxelVotes& votes_;
  std::vector<Kept> kept_;
  const Brick nothing_;  // the brick of voxels without votes
  std::vector<Entry> poll_;
};

template <class T>
void VoxelVotes::read(const LiftedView<T>& view, int32_t* labels, float* confidence) const {
  const int rows = tile_rows(view);
  const int team = static_cast<int64_t>(view.height) * view.width < 4000 ? 1 : threads_;
#pragma omp parallel num_threads(team)
  {
    Reader reader(*this);
#pragma omp for schedule(static)
    for (int row = 0; row < rows; ++row) {
      each_tile(view, row, [&](int left, int right, int top, int bottom) {
        reader.read(view, left, right, top, bottom, labels, confidence);
      });
    }
  }
}

template void VoxelVotes::read(const LiftedView<float>&, int32_t*, float*) const;
template void VoxelVotes::read(const LiftedView<double>&, int32_t*, float*) const;

}  // namespace ops
}  // namespace beags
