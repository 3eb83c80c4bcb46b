#include "frame.h"

#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <type_traits>

namespace beags {
namespace {

bool use_avx2() {
#if defined(__x86_64__)
  static const bool use = [] {
    const char* forced = std::getenv("BEAGS_ISA");
    if (forced && std::strcmp(forced, "baseline") == 0) return false;
    return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  }();
  return use;
#else
  return false;
#endif
}

template <class T>
const Kernels<T>& kernels() {
#if defined(__x86_64__)
  if (use_avx2()) {
    if constexpr (std::is_same_v<T, float>) return avx2::kKernelsF32;
    if constexpr (std::is_same_v<T, double>) return avx2::kKernelsF64;
  }
#endif
  if constexpr (std::is_same_v<T, float>) return baseline::kKernelsF32;
  if constexpr (std::is_same_v<T, double>) return baseline::kKernelsF64;
}

template <class T>
SurfelParameters parameters(const Inputs<T>& inputs, int64_t i) {
  SurfelParameters s;
  std::copy_n(inputs.means + 3 * i, 3, s.mean);
  std::copy_n(inputs.quats + 4 * i, 4, s.quat);
  std::copy_n(inputs.log_scales + 2 * i, 2, s.log_scale);
  s.opacity_logit = inputs.opacity_logits[i];
  std::copy_n(inputs.colors + 3 * i, 3, s.color);
  return s;
}

// Rounds to T; false if that overflows.
template <class T>
bool narrow(const Splat<double>& from, int32_t class_id, Splat<T>& to) {
  const double numbers[] = {from.cx,  from.cy,  from.u_x, from.u_y, from.v_x,         from.v_y,    from.w_x,
                            from.w_y, from.w_0, from.det, from.z,   from.log_opacity, from.tilt_u, from.tilt_v};
  T* fields[] = {&to.cx,  &to.cy,  &to.u_x, &to.u_y, &to.v_x,         &to.v_y,    &to.w_x,
                 &to.w_y, &to.w_0, &to.det, &to.z,   &to.log_opacity, &to.tilt_u, &to.tilt_v};
  bool finite = true;
  for (size_t i = 0; i < sizeof numbers / sizeof *numbers; ++i) {
    *fields[i] = static_cast<T>(numbers[i]);
    finite = finite && std::isfinite(*fields[i]);
  }
  for (int c = 0; c < 3; ++c) {
    to.color[c] = static_cast<T>(from.color[c]);
    to.normal[c] = static_cast<T>(from.normal[c]);
  }
  to.class_id = class_id;
  return finite;
}

}  // namespace

const char* instruction_set() { return use_avx2() ? "avx2" : "baseline"; }

template <class T>
Frame<T>::Frame(const View& view, const Inputs<T>& inputs, bool* visible, int threads)
    : view_(view),
      tiles_x_(tiles_along(view.width)),
      tiles_y_(tiles_along(view.height)),
      num_surfels_(inputs.count),
      splats_(new Splat<T>[inputs.count]) {
  std::vector<Fate> fates(inputs.count);
  // A team costs more than it brings below a few thousand surfels (tens of nanoseconds each).
  const int team = inputs.count < 2000 ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t i = 0; i < inputs.count; ++i) {
    Splat<double> splat;
    fates[i] = project(view_, parameters(inputs, i), splat);
    const int32_t class_id = inputs.class_ids ? inputs.class_ids[i] : 0;
    if (fates[i] == Fate::kDrawn && !narrow(splat, class_id, splats_[i])) fates[i] = Fate::kNonFinite;
  }
  std::vector<int32_t> drawn;
  drawn.reserve(inputs.count);
  for (int64_t i = 0; i < inputs.count; ++i) {
    num_nonfinite_ += fates[i] == Fate::kNonFinite;
    if (fates[i] == Fate::kDrawn) drawn.push_back(static_cast<int32_t>(i));
    visible[i] = false;
  }
  bins_ = bin(view_, splats_.get(), std::move(drawn), visible, team);
}

template <class T>
Job<T> Frame<T>::job() const {
  Job<T> job{};
  job.width = view_.width;
  job.height = view_.height;
  job.tiles_x = tiles_x_;
  job.tiles_y = tiles_y_;
  job.near_plane = static_cast<T>(view_.near_plane);
  job.mapping = static_cast<T>(view_.near_plane / (1 - view_.near_plane / view_.far_plane));
  job.splats = splats_.get();
  job.tile_start = bins_.tile_start.data();
  job.pairs = bins_.pairs.data();
  return job;
}

template <class T>
void Frame<T>::forward(const Images<T>& images, const T* background, const int32_t* target, int threads) {
  geometry_ = images.depth != nullptr;
  distortion_ = images.distortion != nullptr;
  std::copy_n(background, 3, background_);
  const size_t pixels = static_cast<size_t>(tiles()) * kTilePixels;
  end_transmittance_.resize(pixels);
  last_.resize(pixels);
  depth_sum_.resize(geometry_ ? pixels : 0);
  median_pair_.resize(geometry_ ? pixels : 0);
  first_inverse_depth_.resize(distortion_ ? pixels : 0);
  moment1_.resize(distortion_ ? pixels : 0);
  moment2_.resize(distortion_ ? pixels : 0);

  Job<T> job = this->job();
  job.geometry = geometry_;
  job.distortion = distortion_;
  std::copy_n(background, 3, job.background);
  job.target = target;
  job.color = images.color;
  job.alpha = images.alpha;
  job.depth = images.depth;
  job.median_depth = images.median_depth;
  job.normal = images.normal;
  job.distortion_out = images.distortion;
  job.boundary = images.boundary;
  job.end_transmittance = end_transmittance_.data();
  job.last = last_.data();
  job.depth_sum = depth_sum_.data();
  job.median_pair = median_pair_.data();
  job.first_inverse_depth = first_inverse_depth_.data();
  job.moment1 = moment1_.data();
  job.moment2 = moment2_.data();
  // Determinism: tiles share nothing, so any thread may take any of them.
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles(); ++tile) kernels<T>().forward(job, tile);
}

template <class T>
void Frame<T>::backward(const Inputs<T>& inputs, const int32_t* target, const ImageGradients<T>& from,
                        const InputGradients<T>& to, int threads) {
  Job<T> job = this->job();
  job.geometry = geometry_;
  job.distortion = distortion_;
  std::copy_n(background_, 3, job.background);
  job.target = target;
  job.end_transmittance = end_transmittance_.data();
  job.last = last_.data();
  job.depth_sum = depth_sum_.data();
  job.median_pair = median_pair_.data();
  job.first_inverse_depth = first_inverse_depth_.data();
  job.moment1 = moment1_.data();
  job.moment2 = moment2_.data();
  job.g_color = from.color;
  job.g_alpha = from.alpha;
  job.g_depth = from.depth;
  job.g_median_depth = from.median_depth;
  job.g_normal = from.normal;
  job.g_distortion = from.distortion;
  job.g_boundary = from.boundary;
  const std::unique_ptr<T[]> records(new T[bins_.pairs.size() * kRecordSize]);  // the kernels fill all of it
  const std::unique_ptr<T[]> backgrounds(new T[static_cast<size_t>(tiles()) * 3]);
  job.records = records.get();
  job.g_background = backgrounds.get();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles(); ++tile) kernels<T>().backward(job, tile);

  // Determinism: each surfel's records are summed by one thread, in the order of their tiles.
  const int64_t ranks = static_cast<int64_t>(bins_.order.size());
  const int team = ranks < 2000 ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t rank = 0; rank < ranks; ++rank) {
    double sums[kRecordSize] = {};
    for (int64_t record = bins_.record_start[rank]; record < bins_.record_start[rank + 1]; ++record) {
      for (int i = 0; i < kRecordSize; ++i) sums[i] += records[record * kRecordSize + i];
    }
    const int64_t surfel = bins_.order[rank];
    if (bins_.record_start[rank] == bins_.record_start[rank + 1]) continue;
    const SurfelGradients g = project_backward(view_, parameters(inputs, surfel), sums);
    for (int i = 0; i < 3; ++i) to.means[3 * surfel + i] = static_cast<T>(g.mean[i]);
    for (int i = 0; i < 4; ++i) to.quats[4 * surfel + i] = static_cast<T>(g.quat[i]);
    for (int i = 0; i < 2; ++i) to.log_scales[2 * surfel + i] = static_cast<T>(g.log_scale[i]);
    to.opacity_logits[surfel] = static_cast<T>(g.opacity_logit);
    for (int i = 0; i < 3; ++i) to.colors[3 * surfel + i] = static_cast<T>(sums[kColor + i]);
  }
  double background[3] = {};
  for (int tile = 0; tile < tiles(); ++tile) {
    for (int c = 0; c < 3; ++c) background[c] += backgrounds[3 * tile + c];
  }
  for (int c = 0; c < 3; ++c) to.background[c] = static_cast<T>(background[c]);
}

template <class T>
void Frame<T>::class_contributions(const int32_t* labels, int num_classes, T* out, int threads) const {
  // Number each tile's labels 0, 1, ..: a tile rarely has more than a few.
  std::vector<int32_t> slots(static_cast<size_t>(view_.width) * view_.height, -1), num_slots(tiles(), 0);
  std::vector<std::vector<int32_t>> tile_labels(tiles());
  std::vector<int64_t> slot_start(tiles() + 1, 0);
  std::vector<int32_t> slot_of(num_classes, -1);
  for (int tile = 0; tile < tiles(); ++tile) {
    const int x0 = tile % tiles_x_ * kTile, y0 = tile / tiles_x_ * kTile;
    for (int y = y0; y < std::min(y0 + kTile, view_.height); ++y) {
      for (int x = x0; x < std::min(x0 + kTile, view_.width); ++x) {
        const int64_t at = static_cast<int64_t>(y) * view_.width + x;
        const int32_t label = labels[at];
        if (label < 0 || label >= num_classes) continue;
        if (slot_of[label] < 0) {
          slot_of[label] = num_slots[tile]++;
          tile_labels[tile].push_back(label);
        }
        slots[at] = slot_of[label];
      }
    }
    for (const int32_t label : tile_labels[tile]) slot_of[label] = -1;
    slot_start[tile + 1] = slot_start[tile] + (bins_.tile_start[tile + 1] - bins_.tile_start[tile]) * num_slots[tile];
  }
  std::vector<T> sums(slot_start[tiles()], T(0));
  Product<T> product{};
  product.slots = slots.data();
  product.num_slots = num_slots.data();
  product.slot_start = slot_start.data();
  product.sums = sums.data();
  const Job<T> job = this->job();
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles(); ++tile) kernels<T>().class_contributions(job, product, tile);

  // Determinism: one thread adds up, tile after tile.
  for (int tile = 0; tile < tiles(); ++tile) {
    const T* row = sums.data() + slot_start[tile];
    for (int64_t k = bins_.tile_start[tile]; k < bins_.tile_start[tile + 1]; ++k) {
      T* to = out + static_cast<int64_t>(bins_.pairs[k].splat) * num_classes;
      for (const int32_t label : tile_labels[tile]) to[label] += *row++;
    }
  }
}

template <class T>
void Frame<T>::class_map(int num_classes, int32_t* classes, T* share, int threads) const {
  const Job<T> job = this->job();
#pragma omp parallel num_threads(threads)
  {
    std::vector<int32_t> place_of(num_classes, -1), present;
    std::vector<T> sums;
#pragma omp for schedule(dynamic, 1)
    for (int tile = 0; tile < tiles(); ++tile) {
      present.clear();
      for (int64_t k = bins_.tile_start[tile]; k < bins_.tile_start[tile + 1]; ++k) {
        const int32_t id = splats_[bins_.pairs[k].splat].class_id;
        if (place_of[id] < 0) {
          place_of[id] = 0;
          present.push_back(id);
        }
      }
      std::sort(present.begin(), present.end());
      const int32_t count = static_cast<int32_t>(present.size());
      for (int32_t i = 0; i < count; ++i) place_of[present[i]] = i;
      sums.assign(static_cast<size_t>(count) * kTilePixels, T(0));
      Product<T> product{};
      product.labels = present.data();
      product.slots = place_of.data();
      product.num_slots = &count;
      product.sums = sums.data();
      product.classes = classes;
      product.share = share;
      kernels<T>().class_map(job, product, tile);
      for (const int32_t id : present) place_of[id] = -1;
    }
  }
}

template <class T>
void Frame<T>::heaviest(int32_t* indices, int threads) const {
  const Job<T> job = this->job();
  Product<T> product{};
  product.classes = indices;
#pragma omp parallel for num_threads(threads) schedule(dynamic, 1)
  for (int tile = 0; tile < tiles(); ++tile) kernels<T>().heaviest(job, product, tile);
}

template class Frame<float>;
template class Frame<double>;

}  // namespace beags
