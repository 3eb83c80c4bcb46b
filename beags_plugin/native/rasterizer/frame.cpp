#include "rasterizer/frame.h"

#include <algorithm>

#include "simd/isa.h"

namespace beags {
template <class T>
Frame<T>::Frame(const View& view, const Inputs<T>& inputs, bool* visible, int threads)
    : view_(view),
      tiles_x_(tiles_along(view.width)),
      tiles_y_(tiles_along(view.height)),
      num_gaussians_(inputs.count),
      splats_(inputs.count) {
  const int64_t n = inputs.count, chunks = (n + kChunk - 1) / kChunk;
  std::vector<std::vector<Reach>> reached(chunks);
  std::vector<int64_t> record_start(n + 1, 0), nonfinite(chunks, 0);
  const Scratch<T> depths(n);
  const int team = n < kTeamGaussians ? 1 : threads;
  // Determinism: chunks have a fixed size and share nothing.
#pragma omp parallel for num_threads(team) schedule(dynamic, 1)
  for (int64_t chunk = 0; chunk < chunks; ++chunk) {
    reached[chunk].reserve(4 * kChunk);
    for (int64_t i = chunk * kChunk; i < std::min(n, (chunk + 1) * kChunk); ++i) {
      const size_t before = reached[chunk].size();
      const Fate fate = place_gaussian(view_, inputs, i, splats_[i]);
      nonfinite[chunk] += fate == Fate::kNonFinite;
      visible[i] = fate == Fate::kRendered && find_tiles(view_, splats_[i], reached[chunk]);
      record_start[i + 1] = static_cast<int64_t>(reached[chunk].size() - before);
      if (fate == Fate::kRendered) depths[i] = splats_[i].z;
    }
  }
  for (int64_t i = 0; i < n; ++i) record_start[i + 1] += record_start[i];
  for (const int64_t count : nonfinite) num_nonfinite_ += count;
  bins_ = bin(view_, reached, std::move(record_start), depths.get());
}

template <class T>
Job<T> Frame<T>::job() const {
  Job<T> job{};
  job.width = view_.width;
  job.height = view_.height;
  job.tiles_x = tiles_x_;
  job.tiles_y = tiles_y_;
  job.near_plane = static_cast<T>(view_.near_plane);
  job.mapping = static_cast<T>(view_.mapping());
  std::copy_n(background_, 3, job.background);
  job.splats = splats_.get();
  job.tile_start = bins_.tile_start.data();
  job.pairs = bins_.pairs.get();
  job.saved = saved_;
  return job;
}

template <class T>
void Frame<T>::make_saved(bool keep, bool geometry, bool distortion) {
  saved_ = {};
  if (!keep) return;
  const size_t pixels = static_cast<size_t>(tiles()) * kTilePixels;
  size_t used = 0;
  kept_ = Scratch<T>(pixels * Saved<T>::kCount);  // The kernels write all that they read.
  const auto take = [&](bool wanted) { return wanted ? kept_.get() + pixels * used++ : nullptr; };
  saved_.end_transmittance = take(true);
  saved_.end = take(true);
  saved_.depth_sum = take(geometry);
  saved_.median_pair = take(geometry);
  saved_.first = take(distortion);
  saved_.moment1 = take(distortion);
  saved_.moment2 = take(distortion);
}

template <class T>
void Frame<T>::forward(const Images<T>& images, const T* background, const int32_t* target, bool keep, int threads) {
  std::copy_n(background, 3, background_);
  make_saved(keep, images.depth, images.distortion);
  Job<T> job = this->job();
  job.target = target;
  job.images = images;
  const Parts parts =
      (images.depth ? kGeometry : 0) | (images.distortion ? kDistortion : 0) | (images.boundary ? kBoundary : 0);
  const auto kernel = kernels<T>().variants[parts].forward;
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
  const bool only_colors = !wants_geometry(to);
  const Variant<T>& variant = kernels<T>().variants[parts];
  const auto kernel = only_colors ? kernels<T>().backward_colors : variant.backward;
  const int size = only_colors ? kColorRecord : variant.record_size;
  const Scratch<T> records(static_cast<size_t>(num_pairs()) * size);  // the kernels fill all of it
  const Scratch<T> backgrounds(static_cast<size_t>(tiles()) * 3);
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

// Adds up each Gaussian's records and propagates them to its parameters.
template <class T>
void Frame<T>::reduce(const Inputs<T>& inputs, const T* records, int size, const InputGradients<T>& to,
                      int threads) const {
  const auto write = [](T* values, int64_t gaussian, const double* numbers, int count) {
    for (int i = 0; values && i < count; ++i) values[count * gaussian + i] = static_cast<T>(numbers[i]);
  };
  const bool shape = to.means || to.quats || to.log_scales || to.screen_shift;
  const int team = num_gaussians_ < kTeamGaussians ? 1 : threads;
  // Determinism: one thread sums each Gaussian's records, in the order of their tiles.
#pragma omp parallel for num_threads(team) schedule(dynamic, kChunk)
  for (int64_t i = 0; i < num_gaussians_; ++i) {
    double sums[kRecord] = {};
    if (bins_.record_start[i] == bins_.record_start[i + 1]) {
      write(to.colors, i, sums, 3);
      write(to.opacity_logits, i, sums, 1);
      write(to.means, i, sums, 3);
      write(to.quats, i, sums, 4);
      write(to.log_scales, i, sums, 2);
      write(to.screen_shift, i, sums, 2);
      continue;
    }
    for (int64_t record = bins_.record_start[i]; record < bins_.record_start[i + 1]; ++record) {
      for (int number = 0; number < size; ++number) sums[number] += records[record * size + number];
    }
    write(to.colors, i, sums + kColor, 3);
    if (size == kColorRecord) continue;
    const GaussianParameters gaussian = parameters(inputs, i);
    const double g_opacity_logit = sums[kLogOpacity] * gaussian.transparency;  // d log sigmoid = 1 - sigmoid
    write(to.opacity_logits, i, &g_opacity_logit, 1);
    if (!shape) continue;
    const ShapeGradients g = project_backward(view_, gaussian, sums);
    write(to.means, i, g.mean, 3);
    write(to.quats, i, g.quat, 4);
    write(to.log_scales, i, g.log_scale, 2);
    write(to.screen_shift, i, g.screen_shift, 2);
  }
}

template <class T>
void Frame<T>::run_features(Job<T> job, const T* features, int count, void (*kernel)(const Job<T>&, int),
                            int threads) const {
  job.features = features;
  job.num_features = count;
  for_each_tile(threads, [&](int tile) {
    const Scratch<T> work(static_cast<size_t>(count) * (kTilePixels + kGroupPixels));
    Job<T> of_tile = job;
    of_tile.feature_work = work.get();
    kernel(of_tile, tile);
  });
}

template <class T>
void Frame<T>::feature_channels(const T* features, int count, T* channels, bool keep, int threads) {
  make_saved(keep, false, false);
  Job<T> job = this->job();
  job.channels = channels;
  run_features(job, features, count, kernels<T>().feature_channels, threads);
}

template <class T>
void Frame<T>::feature_channels_backward(const Inputs<T>& inputs, const T* features, int count, const T* gradient,
                                         const InputGradients<T>& to, T* g_features, int threads) const {
  Job<T> job = this->job();
  const bool geometry = wants_geometry(to);
  const int size = geometry ? record_size(kFeatures) : 0;
  const Scratch<T> records(static_cast<size_t>(num_pairs()) * size);  // the kernels fill all of both
  const Scratch<T> feature_records(static_cast<size_t>(num_pairs()) * count);
  const Scratch<T> backgrounds(static_cast<size_t>(tiles()) * 3);
  job.records = records.get();
  job.feature_records = feature_records.get();
  job.g_background = backgrounds.get();
  job.channel_gradients = gradient;
  const auto kernel = geometry ? kernels<T>().feature_channels_backward : kernels<T>().backward_features;
  run_features(job, features, count, kernel, threads);
  if (geometry) reduce(inputs, records.get(), size, to, threads);
  if (!g_features) return;
  constexpr int kBlock = 4;
  const int team = num_gaussians_ < kTeamGaussians ? 1 : threads;
  // Determinism: as in `reduce`.
#pragma omp parallel for num_threads(team) schedule(dynamic, kChunk)
  for (int64_t i = 0; i < num_gaussians_; ++i) {
    for (int first = 0; first < count; first += kBlock) {
      double sums[kBlock] = {};
      for (int64_t record = bins_.record_start[i]; record < bins_.record_start[i + 1]; ++record) {
        for (int c = 0; c < kBlock; ++c) sums[c] += feature_records[record * count + first + c];
      }
      for (int c = 0; c < kBlock; ++c) g_features[i * count + first + c] = static_cast<T>(sums[c]);
    }
  }
}

template class Frame<float>;
template class Frame<double>;

}  // namespace beags
