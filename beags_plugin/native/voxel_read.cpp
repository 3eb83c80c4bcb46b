#include <algorithm>
#include <cmath>

#include "voxel_space.h"
#include "voxel_votes.h"

namespace beags {
namespace ops {
namespace {

constexpr int kKept = 512;                   // bricks that were needed last, kept at hand
constexpr int32_t kParts = 64;               // of a voxel, in interpolation weights
constexpr int32_t kMany = -1, kNobody = -2;  // instead of a leading class

}  // namespace

// Reads pixels one after the other.
class VoxelVotes::Reader {
 public:
  explicit Reader(const VoxelVotes& votes) : votes_(votes), kept_(kKept), nothing_(new Voxel[kCells]()) {}

  // The pixel's confidence; sets its label. voted: whether it has voted itself.
  template <class T>
  float read(const LiftedView<T>& view, int x, int y, bool voted, int32_t* label) {
    T point[3], ray[3];
    if (!lift(view, x, y, point, ray)) return 0.0f;
    Place place = about(point);
    const int32_t leader = gather(place);
    int32_t own[3];
    for (int a = 0; a < 3; ++a) own[a] = place.corner[a] + (2 * place.fraction[a] >= kParts);
    const Found at = bricks_[place.brick(own)];
    const Voxel& voxel = at.voxels[cell_of(own[0], own[1], own[2])];
    // More than half of the votes of every voxel are more than half of any weighted sum.
    if (leader >= 0 && voted) {
      *label = leader;
      return share_in(voxel, at.pairs, leader);
    }
    poll_.clear();
    if (!count(place)) {
      for (const T step : {-view.voxel, view.voxel}) {
        const T moved[3] = {point[0] + step * ray[0], point[1] + step * ray[1], point[2] + step * ray[2]};
        place = about(moved);
        gather(place);
        count(place);
      }
    }
    const float share = decide(label);
    return voxel.votes ? share_in(voxel, at.pairs, *label) : share;
  }

 private:
  // The eight voxels about a point: from `corner` on; `fraction` of kParts from the middle of the first to the second.
  struct Place {
    int32_t corner[3], fraction[3];
    int brick(const int32_t* voxel) const {
      return (voxel[0] >> 2 != corner[0] >> 2) << 2 | (voxel[1] >> 2 != corner[1] >> 2) << 1 |
             (voxel[2] >> 2 != corner[2] >> 2);
    }
  };
  struct Found {
    const Voxel* voxels;
    const Pair* pairs;
    int32_t leader;
  };
  struct Kept {
    uint64_t key = ~uint64_t(0);
    Found found{};
  };
  struct Entry {
    int32_t label;
    uint64_t votes;
  };

  template <class T>
  static Place about(const T* point) {
    Place place;
    for (int a = 0; a < 3; ++a) {
      const T at = point[a] - T(0.5);
      const int32_t whole = floor_of(at);
      place.corner[a] = whole + kHalf;
      place.fraction[a] = static_cast<int32_t>((at - static_cast<T>(whole)) * T(kParts));
    }
    return place;
  }

  // The bricks of the eight voxels: one to eight of them. `bricks_` has them by `Place::brick`; the others of it are
  // not asked for. Returns the class that leads in all that have votes, kMany or kNobody.
  int32_t gather(const Place& place) {
    int32_t near[3], far[3];
    for (int a = 0; a < 3; ++a) {
      near[a] = place.corner[a] >> 2;
      far[a] = (place.corner[a] + 1) >> 2;
    }
    int32_t leader = kNobody;
    const int x_end = far[0] != near[0], y_end = far[1] != near[1], z_end = far[2] != near[2];
    for (int x = 0; x <= x_end; ++x) {
      for (int y = 0; y <= y_end; ++y) {
        for (int z = 0; z <= z_end; ++z) {
          Found& found = bricks_[x << 2 | y << 1 | z];
          found = find(near[0] + x, near[1] + y, near[2] + z);
          leader = agreed(leader, found.leader);
        }
      }
    }
    return leader;
  }

  Found find(int32_t x, int32_t y, int32_t z) {
    const uint64_t key = brick_key(x, y, z);
    Kept& kept = kept_[(x + 5 * y + 25 * z) & (kKept - 1)];
    if (kept.key != key) {
      const uint64_t hash = hash_of(key);
      const Brick* brick = votes_.shares_[hash >> 58].find(key, hash);
      kept = {key, brick ? Found{brick->voxels.get(), brick->pairs, brick->leader}
                         : Found{nothing_.get(), nullptr, kNobody}};
    }
    return kept.found;
  }

  static int32_t agreed(int32_t one, int32_t other) {
    return one == kNobody ? other : other == kNobody || one == other ? one : kMany;
  }

  // Adds the votes of the eight voxels, interpolated. Whether one class has more than half of the votes of each.
  bool count(const Place& place) {
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
    int32_t leader = kNobody;
    for (int i = 0; i < 8; ++i) {
      const int x = i >> 2, y = i >> 1 & 1, z = i & 1;
      const Found& at = bricks_[brick[0][x] | brick[1][y] | brick[2][z]];
      const Voxel& found = at.voxels[cell[0][x] | cell[1][y] | cell[2][z]];
      const uint64_t share = weight[0][x] * weight[1][y] * weight[2][z];
      if (found.votes == 0) continue;
      if (found.label >= 0) {
        leader = agreed(leader, found.label);
        add(found.label, share * found.votes);
      } else {
        leader = agreed(leader, leader_of(found, at.pairs));
        const Pair* pair = at.pairs + ~found.label;
        for (uint32_t k = 0; k < found.votes; ++k) add(pair[k].label, share * pair[k].votes);
      }
    }
    return leader >= 0;
  }

  // Determinism: whole numbers, whose sums have no order.
  void add(int32_t label, uint64_t votes) {
    for (Entry& entry : poll_) {
      if (entry.label == label) {
        entry.votes += votes;
        return;
      }
    }
    poll_.push_back({label, votes});
  }

  // The winner's share; 0 if nobody voted. Several that lead leave the label.
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

  // The label's share of the votes of a voxel that has some, or 0.
  static float share_in(const Voxel& voxel, const Pair* pairs, int32_t label) {
    if (voxel.votes == 0 || voxel.label >= 0) return voxel.votes && voxel.label == label ? 1.0f : 0.0f;
    uint64_t total = 0, own = 0;
    for (uint32_t k = 0; k < voxel.votes; ++k) {
      const Pair& pair = pairs[~voxel.label + k];
      total += pair.votes;
      if (pair.label == label) own = pair.votes;
    }
    return static_cast<float>(own) / static_cast<float>(total);
  }

  const VoxelVotes& votes_;
  std::vector<Kept> kept_;
  std::unique_ptr<Voxel[]> nothing_;
  Found bricks_[8];
  std::vector<Entry> poll_;
};

template <class T>
void VoxelVotes::read(const LiftedView<T>& view, int32_t* labels, float* confidence, int32_t ignore) const {
  const int rows = tile_rows(view);
  const int team = static_cast<int64_t>(view.height) * view.width < 4000 ? 1 : threads_;
#pragma omp parallel num_threads(team)
  {
    Reader reader(*this);
#pragma omp for schedule(static)
    for (int row = 0; row < rows; ++row) {
      each_pixel(view, row, [&](int x, int y) {
        const int64_t i = static_cast<int64_t>(y) * view.width + x;
        confidence[i] = reader.read(view, x, y, labels[i] != ignore, labels + i);
      });
    }
  }
}

template void VoxelVotes::read(const LiftedView<float>&, int32_t*, float*, int32_t) const;
template void VoxelVotes::read(const LiftedView<double>&, int32_t*, float*, int32_t) const;

}  // namespace ops
}  // namespace beags
