#include "frame.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "isa.h"

namespace beags {
namespace {

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
  bool finite = true;
  const auto round = [&](double number) {
    const T rounded = static_cast<T>(number);
    finite = finite && std::isfinite(rounded);
    return rounded;
  };
  to.cx = round(from.cx);
  to.cy = round(from.cy);
  to.u_x = round(from.u_x);
  to.u_y = round(from.u_y);
  to.v_x = round(from.v_x);
  to.v_y = round(from.v_y);
  to.w_x = round(from.w_x);
  to.w_y = round(from.w_y);
  to.w_0 = round(from.w_0);
  to.det = round(from.det);
  to.z = round(from.z);
  to.inverse_z = round(from.inverse_z);
  to.log2_opacity = round(from.log2_opacity);
  to.tilt_u = round(from.tilt_u);
  to.tilt_v = round(from.tilt_v);
  // Edge-on, det = 0: no hit reads its inverse, which must only not be NaN.
  constexpr double kLargest = std::numeric_limits<T>::max();
  to.inverse_det = static_cast<T>(std::clamp(from.inverse_det, -kLargest, kLargest));
  for (int c = 0; c < 3; ++c) {
    to.color[c] = static_cast<T>(from.color[c]);
    to.normal[c] = static_cast<T>(from.normal[c]);
  }
  to.class_id = class_id;
  to.plain = from.plain;
  return finite;
}

}  // namespace

template <class T>
Frame<T>::Frame(const View& view, const Inputs<T>& inputs, bool* visible, int threads)
    : view_(view),
      tiles_x_(tiles_along(view.width)),
      tiles_y_(tiles_along(view.height)),
      num_surfels_(inputs.count),
      splats_(new Splat<T>[inputs.count]) {
  std::vector<Fate> fates(inputs.count);
  const int team = inputs.count < kTeamSurfels ? 1 : threads;
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
  std::copy_n(background_, 3, job.background);
  job.splats = splats_.get();
  job.tile_start = bins_.tile_start.data();
  job.pairs = bins_.pairs.data();
  job.saved = saved_;
  return job;
}

template <class T>
void Frame<T>::forward(const Images<T>& images, const T* background, const int32_t* target, bool keep, int threads) {
  std::copy_n(background, 3, background_);
  saved_ = {};
  if (keep) {
    const size_t pixels = static_cast<size_t>(tiles()) * kTilePixels;
    size_t used = 0;
    kept_.reset(new T[pixels * Saved<T>::kCount]);  // the kernels fill all of it that they read
    const auto take = [&](bool wanted) { return wanted ? kept_.get() + pixels * used++ : nullptr; };
    saved_.end_transmittance = take(true);
    saved_.end = take(true);
    saved_.depth_sum = take(images.depth);
    saved_.median_pair = take(images.depth);
    saved_.first = take(images.distortion);
    saved_.moment1 = take(images.distortion);
    saved_.moment2 = take(images.distortion);
  }
  Job<T> job = this->job();
  job.target = target;
  job.images = images;
  const Parts parts =
      (images.depth ? kGeometry : 0) | (images.distortion ? kDistortion : 0) | (images.boundary ? kBoundary : 0);
  const auto kernel = kernels<T>().forward[parts];
  // Determinism: tiles share nothing, so any thread may take any of them.
  for_each_tile(threads, [&](int tile) { kernel(job, tile); });
}

template <class T>
void Frame<T>::backward(const Inputs<T>& inputs, const int32_t* target, const Images<const T>& from,
                        const InputGradients<T>& to, int threads) const {
  Job<T> job = this->job();
  job.target = target;
  job.gradients = from;
  const Parts parts = (from.depth || from.median_depth || from.normal ? kGeometry : 0) |
                      (from.distortion ? kDistortion : 0) | (from.boundary ? kBoundary : 0);
  const bool only_colors = !to.means && !to.quats && !to.log_scales && !to.opacity_logits;
  const auto kernel = only_colors ? kernels<T>().backward_colors : kernels<T>().backward[parts];
  const int size = only_colors ? kColorRecord : record_size(variant<T>(parts));
  const std::unique_ptr<T[]> records(new T[static_cast<size_t>(num_pairs()) * size]);  // the kernels fill all of it
  const std::unique_ptr<T[]> backgrounds(new T[static_cast<size_t>(tiles()) * 3]);
  job.records = records.get();
  job.g_background = backgrounds.get();
  for_each_tile(threads, [&](int tile) { kernel(job, tile); });

  reduce(inputs, records.get(), size, to, threads);
  if (!to.background) return;
  double background[3] = {};
  for (int tile = 0; tile < tiles(); ++tile) {
    for (int c = 0; c < 3; ++c) background[c] += backgrounds[3 * tile + c];
  }
  for (int c = 0; c < 3; ++c) to.background[c] = static_cast<T>(background[c]);
}

// Adds up each surfel's records and carries them on to its parameters.
template <class T>
void Frame<T>::reduce(const Inputs<T>& inputs, const T* records, int size, const InputGradients<T>& to,
                      int threads) const {
  const auto write = [](T* values, int64_t surfel, const double* numbers, int count) {
    for (int i = 0; values && i < count; ++i) values[count * surfel + i] = static_cast<T>(numbers[i]);
  };
  const int64_t ranks = static_cast<int64_t>(bins_.order.size());
  const int team = ranks < kTeamSurfels ? 1 : threads;
  // Determinism: each surfel's records are summed by one thread, in the order of their tiles.
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t rank = 0; rank < ranks; ++rank) {
    if (bins_.record_start[rank] == bins_.record_start[rank + 1]) continue;
    double sums[kRecord] = {};
    for (int64_t record = bins_.record_start[rank]; record < bins_.record_start[rank + 1]; ++record) {
      for (int i = 0; i < size; ++i) sums[i] += records[record * size + i];
    }
    const int64_t surfel = bins_.order[rank];
    write(to.colors, surfel, sums + kColor, 3);
    if (size == kColorRecord) continue;
    const SurfelGradients g = project_backward(view_, parameters(inputs, surfel), sums);
    write(to.means, surfel, g.mean, 3);
    write(to.quats, surfel, g.quat, 4);
    write(to.log_scales, surfel, g.log_scale, 2);
    write(to.opacity_logits, surfel, &g.opacity_logit, 1);
  }
}

template class Frame<float>;
template class Frame<double>;

}  // namespace beags
