// Computes the occupancy loss of one block of Gaussians (method, section 6; E9): values and closed-form gradients in
// one pass. A lane is a Gaussian: sums over samples need no exchange between lanes, and a Gaussian's result does not
// depend on its neighbours. Included once for each instruction set.
#pragma once

#include "ops/kernels.h"
#include "ops/lanes.h"
#include "ops/occupancy_loss_random.h"
#include "ops/occupancy_loss_terms.h"
#include "ops/voxel_table.h"
#include "rasterizer/quaternion.h"

namespace beags {
namespace ops {
namespace BEAGS_ISA {

constexpr int kFarOff = 1 << 20;  // size of a box that cannot be looked up
// The memory in which a batch's samples are looked up: registers for discs within 4 x 4 x 4 voxels; a window of bricks
// per disc; the table for large discs and for discs far from all voxels.
enum class Reach { kNear, kWindow, kFar };

// A batch of Gaussians to be sampled, one per lane.
template <class T>
struct OccupancyBatch {
  // Corner of the voxels around the disc, and which of them are valid: two words of 32 bits, or 3 x 3 x 3 bricks.
  typename Lanes<T>::Whole low[3][Lanes<T>::kCount], valid[2][Lanes<T>::kCount];
  uint64_t bricks[Lanes<T>::kCount][kWindow * kWindow * kWindow];
  int64_t gaussian[Lanes<T>::kCount];
  int32_t class_id[Lanes<T>::kCount];
  int count;
};

// The voxels that a batch's discs reach: `size` voxels along each axis, from `low`; `largest` is the largest size, or
// larger than any window if a disc is too far away to be looked up.
template <class T>
struct Boxes {
  typename Lanes<T>::Int low[3], size[3], largest;
};

// Gathers from[kStride * lane].
template <int kStride, class T>
BEAGS_INLINE RealOf<T> strided(const T* from) {
  RealOf<T> out;
  for (int lane = 0; lane < Lanes<T>::kCount; ++lane) out[lane] = from[kStride * lane];
  return out;
}

// The parameters of one Gaussian a lane.
template <class T>
struct Parameters {
  RealOf<T> mean[3], quat[4], log_scale[2], logit;

  // Reads neighbours, from `first`.
  BEAGS_INLINE Parameters(const OccupancyJob<T>& job, int64_t first) {
    for (int axis = 0; axis < 3; ++axis) mean[axis] = strided<3>(job.means + 3 * first + axis);
    for (int part = 0; part < 4; ++part) quat[part] = strided<4>(job.quats + 4 * first + part);
    for (int axis = 0; axis < 2; ++axis) log_scale[axis] = strided<2>(job.log_scales + 2 * first + axis);
    logit = load(job.opacity_logits + first);
  }
  // Reads any Gaussians.
  BEAGS_INLINE Parameters(const OccupancyJob<T>& job, const int64_t* gaussian) {
    for (int lane = 0; lane < Lanes<T>::kCount; ++lane) {
      const int64_t i = gaussian[lane];
      for (int axis = 0; axis < 3; ++axis) mean[axis][lane] = job.means[3 * i + axis];
      for (int part = 0; part < 4; ++part) quat[part][lane] = job.quats[4 * i + part];
      for (int axis = 0; axis < 2; ++axis) log_scale[axis][lane] = job.log_scales[2 * i + axis];
      logit[lane] = job.opacity_logits[i];
    }
  }
};

// Reads the Gaussians first .. first + count - 1; spare lanes get the last one.
template <class T>
BEAGS_INLINE Parameters<T> parameters(const OccupancyJob<T>& job, int64_t first, int count) {
  constexpr int kCount = Lanes<T>::kCount;
  if (count == kCount) return {job, first};
  int64_t gaussian[kCount];
  for (int lane = 0; lane < kCount; ++lane) gaussian[lane] = first + (lane < count ? lane : count - 1);
  return {job, gaussian};
}

// The discs of one Gaussian a lane. All is inlined, so that unused results cost nothing.
template <class T>
struct Discs : DiscFrame<RealOf<T>> {
  using R = RealOf<T>;
  using Frame = DiscFrame<R>;
  using Frame::inverse_length, Frame::r0, Frame::r1, Frame::scale;

  BEAGS_INLINE Discs(const OccupancyJob<T>& job, const Parameters<T>& raw) {
    for (int axis = 0; axis < 2; ++axis) scale[axis] = exponential(raw.log_scale[axis]);
    fill_frame(job, raw.mean, raw.quat, static_cast<Frame&>(*this));
  }

  // Returns NaN for broken Gaussians: a number is not finite, a scale is 0 or a quaternion is unusable.
  BEAGS_INLINE R nan_if_broken(const Parameters<T>& raw) const {
    const R zero = {}, one = zero + T(1), infinite = zero + static_cast<T>(INFINITY);
    const R long_enough = select(inverse_length <= zero + static_cast<T>(kLongestQuat), zero, infinite);
    const R short_enough = select(inverse_length >= zero + static_cast<T>(1 / kLongestQuat), zero, infinite);
    R sum = nan_unless_finite(raw.logit) + nan_unless_finite(long_enough) + nan_unless_finite(short_enough);
    for (int axis = 0; axis < 2; ++axis) {
      sum += nan_unless_finite(raw.log_scale[axis]) + nan_unless_finite(one / scale[axis]);
    }
    for (int axis = 0; axis < 3; ++axis) {
      sum += nan_unless_finite(raw.mean[axis]) +
             nan_unless_finite(T(3) * scale[0] * r0[axis] + T(3) * scale[1] * r1[axis]);
    }
    return sum;
  }
};

template <class T>
BEAGS_INLINE Boxes<T> boxes_around(const Discs<T>& discs) {
  using R = RealOf<T>;
  const R zero = {};
  Boxes<T> boxes;
  boxes.largest = typename Lanes<T>::Int{};
  const auto far_off = boxes.largest + kFarOff;
  for (int axis = 0; axis < 3; ++axis) {
    const R center = discs.center[axis], size = select(center < zero, -center, center);
    const R half = reach_along<T>(discs.axis_u[axis], discs.axis_v[axis], size);
    const auto near = size + half < static_cast<T>(kVoxelHalf);  // Other values, and NaN, have no whole numbers.
    boxes.low[axis] = floor_to_int(select(near, center - half, zero));
    boxes.size[axis] = floor_to_int(select(near, center + half, zero)) - boxes.low[axis] + 1;
    const auto seen = select(near, boxes.size[axis], far_off);
    boxes.largest = select(seen > boxes.largest, seen, boxes.largest);
  }
  return boxes;
}

// Writes the gradients of a batch from its six sums; returns the sum of its losses.
template <class T>
BEAGS_INLINE double finish(const OccupancyJob<T>& job, const OccupancyBatch<T>& batch, const Discs<T>& discs,
                           RealOf<T> opacity, const RealOf<T>* sums) {
  using R = RealOf<T>;
  constexpr int kCount = Lanes<T>::kCount;
  T value[kCount];
  store(value, opacity * sums[0]);
  double total = 0;
  for (int lane = 0; lane < batch.count; ++lane) total += value[lane];
  if (!job.g_means) return total * job.factor;

  R gradients[10];
  disc_gradients(job, static_cast<const DiscFrame<R>&>(discs), opacity, sums, gradients);
  T out[10][kCount];
  for (int number = 0; number < 10; ++number) store(out[number], gradients[number]);
  for (int lane = 0; lane < batch.count; ++lane) {
    const int64_t i = batch.gaussian[lane];
    for (int axis = 0; axis < 3; ++axis) job.g_means[3 * i + axis] = out[axis][lane];
    for (int part = 0; part < 4; ++part) job.g_quats[4 * i + part] = out[3 + part][lane];
    for (int axis = 0; axis < 2; ++axis) job.g_log_scales[2 * i + axis] = out[7 + axis][lane];
    job.g_opacity_logits[i] = out[9][lane];
  }
  return total * job.factor;
}

// Samples a batch and sums G Q times 1, u, v, u^2, v^2, u v.
template <Reach kReach, class T>
BEAGS_INLINE double sample(const OccupancyJob<T>& job, OccupancyBatch<T>& batch) {
  using R = RealOf<T>;
  using I = typename Lanes<T>::Int;
  constexpr int kCount = Lanes<T>::kCount;
  for (int lane = batch.count; lane < kCount; ++lane) {  // Copies fill the spare lanes.
    for (auto& low : batch.low) low[lane] = low[0];
    for (auto& valid : batch.valid) valid[lane] = valid[0];
    if (kReach == Reach::kWindow) __builtin_memcpy(batch.bricks[lane], batch.bricks[0], sizeof batch.bricks[0]);
    batch.gaussian[lane] = batch.gaussian[0];
    batch.class_id[lane] = batch.class_id[0];
  }
  const Parameters<T> raw(job, batch.gaussian);
  const Discs<T> discs(job, raw);
  const R one = R{} + T(1), opacity = one / (one + exponential(-raw.logit));
  I low[3], words[2];
  __builtin_memcpy(low, batch.low, sizeof low);
  __builtin_memcpy(words, batch.valid, sizeof words);
  uint64_t state[kCount];  // hash of stream and Gaussian
  for (int lane = 0; lane < kCount; ++lane) {
    state[lane] = mix(static_cast<uint64_t>(batch.gaussian[lane]) * kGolden + job.stream);
  }
  Counter<T> counter(state);
  R sums[6] = {};
  for (int64_t s = 0; s < job.samples; ++s) {
    I radial, angle;
    counter.next(radial, angle);
    const R area = to_real(radial) * T(1.0 / (1 << 24));  // (r / 3)^2: area grows with the square of the radius
    const R radius = T(3) * sqrt(area);
    R u, v;
    cos_sin(angle, u, v);
    u *= radius;
    v *= radius;
    R at[3];
    for (int axis = 0; axis < 3; ++axis) {
      at[axis] = fma(v, discs.axis_v[axis], fma(u, discs.axis_u[axis], discs.center[axis]));
    }
    I valid;
    I index[3];
    if constexpr (kReach != Reach::kFar) {
      for (int axis = 0; axis < 3; ++axis) index[axis] = floor_to_int(at[axis]) - low[axis];
    } else {
      const R limit = R{} + static_cast<T>(kVoxelHalf + 4);
      for (int axis = 0; axis < 3; ++axis) {
        const R low_held = select(at[axis] > -limit, at[axis], -limit);
        index[axis] = floor_to_int(select(low_held < limit, low_held, limit)) + static_cast<int32_t>(kVoxelShift);
      }
    }
    if constexpr (kReach == Reach::kNear) {
      const I place = index[0] << 4 | index[1] << 2 | index[2];
      const I half = -(place >> 5 & 1);
      valid = -(((words[0] & ~half) | (words[1] & half)) >> (place & 31) & 1);
    } else {
      const I place = (index[0] & 3) << 4 | (index[1] & 3) << 2 | (index[2] & 3);
      for (int axis = 0; axis < 3; ++axis) index[axis] >>= 2;
      const I brick = (index[0] * kWindow + index[1]) * kWindow + index[2];
      valid = I{};
      for (int lane = 0; lane < kCount; ++lane) {
        const uint64_t bits = kReach == Reach::kWindow ? batch.bricks[lane][brick[lane]]
                                                       : brick_bits(*job.valid, batch.class_id[lane], index[0][lane],
                                                                    index[1][lane], index[2][lane]);
        valid[lane] = -static_cast<int32_t>(bits >> place[lane] & 1);
      }
    }
    const R weight = (R)((I)exponential(T(-4.5) * area) & ~valid);
    add_sample(weight, u, v, sums);
  }
  const double total = finish(job, batch, discs, opacity, sums);
  batch.count = 0;
  return total;
}

// The Gaussians of a block that wait to be sampled, sorted by their Reach.
template <class T>
struct Waiting {
  const OccupancyJob<T>& job;
  OccupancyBatch<T> near, window, far;
  int64_t active = 0;
  double total = 0;

  BEAGS_INLINE explicit Waiting(const OccupancyJob<T>& whole) : job(whole) {
    near.count = window.count = far.count = 0;
  }

  template <Reach kReach>
  BEAGS_INLINE OccupancyBatch<T>& batch() {
    return kReach == Reach::kNear ? near : kReach == Reach::kWindow ? window : far;
  }

  // Adds one Gaussian; samples a full batch.
  template <Reach kReach>
  BEAGS_INLINE void add(int64_t gaussian, const int64_t* low, uint64_t valid) {
    OccupancyBatch<T>& to = batch<kReach>();
    const int at = to.count++;
    for (int axis = 0; axis < 3; ++axis) to.low[axis][at] = static_cast<typename Lanes<T>::Whole>(low[axis]);
    for (int word = 0; word < 2; ++word) to.valid[word][at] = static_cast<int32_t>(valid >> 32 * word);
    to.gaussian[at] = gaussian;
    to.class_id[at] = job.class_ids[gaussian];
    ++active;
    if (to.count == Lanes<T>::kCount) draw<kReach>();
  }

  template <Reach kReach>
  void draw() {
    if (batch<kReach>().count) total += sample<kReach>(job, batch<kReach>());
  }
};

// Returns a bit for each lane: whether its box lies in a cube of 1, 2 or 3 valid voxels along each side, by one lookup.
// It has no branches, so that the lookups of all lanes run at once. All tables must be arrays.
template <class T>
BEAGS_INLINE unsigned in_cubes(const VoxelTable* cubes, const Boxes<T>& boxes, const int32_t* class_ids) {
  using I = typename Lanes<T>::Int;
  using Whole = typename Lanes<T>::Whole;
  constexpr int kCount = Lanes<T>::kCount;
  static_assert(kLargestCube == 3, "one choice for each size");
  const I zero = {}, is_two = boxes.largest == zero + 2, is_three = boxes.largest == zero + 3;
  I offset;
  for (int lane = 0; lane < kCount; ++lane) offset[lane] = class_ids[lane];
  const I counted = (boxes.largest <= zero + kLargestCube) & (offset >= zero) & (offset < zero + cubes->num_classes);
  offset &= counted;
  I place = zero;
  for (int axis = 0; axis < 3; ++axis) {
    const I base = select(is_two, zero + cubes[1].base[axis],
                          select(is_three, zero + cubes[2].base[axis], zero + cubes[0].base[axis]));
    const I size = select(is_two, zero + cubes[1].size[axis],
                          select(is_three, zero + cubes[2].size[axis], zero + cubes[0].size[axis]));
    const I index = (boxes.low[axis] & counted) + static_cast<Whole>(kVoxelShift);
    I at = (index >> 2) - base;
    at &= at > zero;
    at = select(at < size, at, size - 1);
    offset = (offset * size + at) & counted;
    place = place << 2 | (index & 3);
  }
  const uint64_t none = 0;
  const uint64_t* const tables[] = {&none, cubes[0].dense, cubes[1].dense, cubes[2].dense};
  const I table = boxes.largest & counted;
  Whole tables_at[kCount], offsets[kCount], places[kCount];  // Single lanes are read faster from memory.
  __builtin_memcpy(tables_at, &table, sizeof table);
  __builtin_memcpy(offsets, &offset, sizeof offset);
  __builtin_memcpy(places, &place, sizeof place);
  unsigned inside = 0;
  for (int lane = 0; lane < kCount; ++lane) {
    inside |= static_cast<unsigned>(tables[tables_at[lane]][offsets[lane]] >> places[lane] & 1) << lane;
  }
  return inside;
}

template <class T>
double occupancy_block(const OccupancyJob<T>& job, int64_t first, int64_t last, int64_t* active) {
  constexpr int kCount = Lanes<T>::kCount;
  const int64_t count = last - first;
  if (job.g_means) {
    __builtin_memset(job.g_means + 3 * first, 0, 3 * count * sizeof(T));
    __builtin_memset(job.g_quats + 4 * first, 0, 4 * count * sizeof(T));
    __builtin_memset(job.g_log_scales + 2 * first, 0, 2 * count * sizeof(T));
    __builtin_memset(job.g_opacity_logits + first, 0, count * sizeof(T));
  }
  bool arrays = true;
  for (int cube = 0; cube < kLargestCube; ++cube) arrays = arrays && job.valid[cube].dense;
  Waiting<T> waiting(job);
  for (int64_t start = first; start < last; start += kCount) {
    const int here = static_cast<int>(last - start < kCount ? last - start : kCount);
    const Parameters<T> raw = parameters(job, start, here);
    const Discs<T> discs(job, raw);
    const Boxes<T> boxes = boxes_around(discs);
    int32_t class_ids[kCount] = {};
    if (here == kCount) {
      __builtin_memcpy(class_ids, job.class_ids + start, sizeof class_ids);
    } else {
      for (int lane = 0; lane < here; ++lane) class_ids[lane] = job.class_ids[start + lane];
    }
    // The loss of a disc that lies wholly inside is exactly 0. Most lie in a cube.
    const unsigned inside = job.skip && arrays ? in_cubes(job.valid, boxes, class_ids) : 0;
    unsigned left = ~inside & ((1u << here) - 1);
    if (!left) continue;
    T broken[kCount];
    store(broken, discs.nan_if_broken(raw));
    for (; left; left &= left - 1) {
      const int lane = __builtin_ctz(left);
      const int64_t i = start + lane;
      const int32_t class_id = class_ids[lane];
      if (broken[lane] != broken[lane] || (!job.background && class_id == 0)) continue;
      int64_t low[3] = {};
      if (class_id < 0 || class_id >= job.valid->num_classes) {  // The class has no voxels.
        waiting.template add<Reach::kNear>(i, low, 0);
        continue;
      }
      int n[3];
      for (int axis = 0; axis < 3; ++axis) {
        low[axis] = boxes.low[axis][lane];
        n[axis] = static_cast<int>(boxes.size[axis][lane]);
      }
      const auto largest = boxes.largest[lane];
      const bool look = job.skip && !arrays && largest <= kLargestCube;
      if (look && voxel_bit(job.valid[largest - 1], class_id, low)) continue;
      if (largest <= 4) {
        const uint64_t valid = voxel_box(*job.valid, class_id, low, n), box = box_bits(n[0], n[1], n[2]);
        if (!job.skip || (valid & box) != box) waiting.template add<Reach::kNear>(i, low, valid);
      } else if (largest <= kWindowVoxels) {
        uint64_t* bricks = waiting.window.bricks[waiting.window.count];
        const bool inside_window = fill_window(*job.valid, class_id, low, n, bricks);
        if (!job.skip || !inside_window) waiting.template add<Reach::kWindow>(i, low, 0);
      } else {
        waiting.template add<Reach::kFar>(i, low, 0);
      }
    }
  }
  waiting.template draw<Reach::kNear>();
  waiting.template draw<Reach::kWindow>();
  waiting.template draw<Reach::kFar>();
  *active += waiting.active;
  return waiting.total;
}

}  // namespace BEAGS_ISA
}  // namespace ops
}  // namespace beags
