// Answers a frame's queries, which have no gradient (sections 3 and 5).
#include <algorithm>
#include <vector>

#include "rasterizer/extent.h"
#include "rasterizer/frame.h"
#include "simd/isa.h"

namespace beags {

template <class T>
typename Frame<T>::LabelSums Frame<T>::label_sums(const int32_t* labels, int num_classes,
                                                  void (*kernel)(const Job<T>&, const Query<T>&, int), Query<T> query,
                                                  int threads) const {
  LabelSums found;
  // Numbers each tile's labels 0, 1, ..: a tile rarely has more than a few.
  std::vector<int32_t> slots(static_cast<size_t>(view_.width) * view_.height, -1), num_slots(tiles(), 0);
  std::vector<std::vector<int32_t>>& tile_labels = found.tile_labels;
  tile_labels.resize(tiles());
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
  found.sums.assign(slot_start[tiles()], T(0));
  query.slots = slots.data();
  query.num_slots = num_slots.data();
  query.slot_start = slot_start.data();
  query.sums = found.sums.data();
  const Job<T> job = this->job();
  for_each_tile(threads, [&](int tile) {
    const int64_t pairs = bins_.tile_start[tile + 1] - bins_.tile_start[tile];
    std::vector<Contribution<T>> work(kTilePixels * std::min<int64_t>(query.within, pairs));
    Query<T> own = query;
    own.found = work.data();
    kernel(job, own, tile);
  });

  found.row_of.resize(num_pairs());
  found.tile_of.resize(num_pairs());
  for_each_tile(threads, [&](int tile) {
    for (int64_t k = bins_.tile_start[tile]; k < bins_.tile_start[tile + 1]; ++k) {
      const int32_t record = bins_.pairs[k].record;
      found.row_of[record] = slot_start[tile] + (k - bins_.tile_start[tile]) * num_slots[tile];
      found.tile_of[record] = tile;
    }
  });
  return found;
}

template <class T>
void Frame<T>::class_contributions(const int32_t* labels, int num_classes, T* out, int threads) const {
  const LabelSums found = label_sums(labels, num_classes, kernels<T>().class_contributions, {}, threads);
  const int team = num_gaussians_ < kTeamGaussians ? 1 : threads;
  // Determinism: one thread sums each Gaussian's records, in the order of their tiles.
#pragma omp parallel for num_threads(team) schedule(dynamic, kChunk)
  for (int64_t i = 0; i < num_gaussians_; ++i) {
    for (int64_t record = bins_.record_start[i]; record < bins_.record_start[i + 1]; ++record) {
      const T* row = found.sums.data() + found.row_of[record];
      for (const int32_t label : found.tile_labels[found.tile_of[record]]) out[i * num_classes + label] += *row++;
    }
  }
}

template <class T>
Contributions<T> Frame<T>::sparse_class_contributions(const int32_t* labels, int num_classes, int threads) const {
  return sparse(label_sums(labels, num_classes, kernels<T>().class_contributions, {}, threads), num_classes, threads);
}

template <class T>
Contributions<T> Frame<T>::sparse_class_pixel_counts(const int32_t* labels, int num_classes, T min_weight,
                                                     int threads) const {
  Query<T> query{};
  query.min_weight = min_weight;
  return sparse(label_sums(labels, num_classes, kernels<T>().class_pixel_counts, query, threads), num_classes, threads);
}

template <class T>
Contributions<T> Frame<T>::sparse_top_contributions(const int32_t* labels, int num_classes, int most, int within,
                                                    int threads) const {
  Query<T> query{};
  query.most = most;
  query.within = within;
  return sparse(label_sums(labels, num_classes, kernels<T>().top_contributions, query, threads), num_classes, threads);
}

template <class T>
Contributions<T> Frame<T>::sparse(const LabelSums& found, int num_classes, int threads) const {
  const int64_t chunks = (num_gaussians_ + kChunk - 1) / kChunk;
  std::vector<Contributions<T>> parts(chunks);
  const int team = num_gaussians_ < kTeamGaussians ? 1 : threads;
#pragma omp parallel num_threads(team)
  {
    std::vector<T> sum_of(num_classes, T(0));
    std::vector<char> is_present(num_classes, 0);
    std::vector<int32_t> present;
    // Determinism: as in class_contributions; the parts are joined in the order of the Gaussians.
#pragma omp for schedule(dynamic, 1)
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      for (int64_t i = chunk * kChunk; i < std::min<int64_t>((chunk + 1) * kChunk, num_gaussians_); ++i) {
        present.clear();
        for (int64_t record = bins_.record_start[i]; record < bins_.record_start[i + 1]; ++record) {
          const T* row = found.sums.data() + found.row_of[record];
          for (const int32_t label : found.tile_labels[found.tile_of[record]]) {
            if (!is_present[label]) present.push_back(label);
            is_present[label] = 1;
            sum_of[label] += *row++;
          }
        }
        std::sort(present.begin(), present.end());
        for (const int32_t label : present) {
          if (sum_of[label] != T(0)) {
            parts[chunk].keys.push_back(i * num_classes + label);
            parts[chunk].values.push_back(sum_of[label]);
          }
          sum_of[label] = T(0);
          is_present[label] = 0;
        }
      }
    }
  }
  Contributions<T> all;
  size_t total = 0;
  for (const Contributions<T>& part : parts) total += part.keys.size();
  all.keys.reserve(total);
  all.values.reserve(total);
  for (const Contributions<T>& part : parts) {
    all.keys.insert(all.keys.end(), part.keys.begin(), part.keys.end());
    all.values.insert(all.values.end(), part.values.begin(), part.values.end());
  }
  return all;
}

template <class T>
template <class Work>
void Frame<T>::for_each_tile_of_classes(int num_classes, int threads, Work work) const {
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
      Query<T> query{};
      query.labels = present.data();
      query.slots = place_of.data();
      query.num_slots = &count;
      query.sums = sums.data();
      query.num_channels = num_classes;
      work(query, tile);
      for (const int32_t id : present) place_of[id] = -1;
    }
  }
}

template <class T>
void Frame<T>::class_map(int num_classes, int32_t* classes, T* share, int threads) const {
  const Job<T> job = this->job();
  const auto kernel = kernels<T>().class_map;
  for_each_tile_of_classes(num_classes, threads, [&](Query<T>& query, int tile) {
    query.classes = classes;
    query.share = share;
    kernel(job, query, tile);
  });
}

template <class T>
void Frame<T>::class_channels(int num_classes, T* channels, bool keep, int threads) {
  make_saved(keep, false, false);
  const Job<T> job = this->job();
  const auto kernel = kernels<T>().class_channels;
  for_each_tile_of_classes(num_classes, threads, [&](Query<T>& query, int tile) {
    query.channels = channels;
    kernel(job, query, tile);
  });
}

template <class T>
void Frame<T>::class_channels_backward(const Inputs<T>& inputs, int num_classes, const T* gradient,
                                       const InputGradients<T>& to, int threads) const {
  Job<T> job = this->job();
  const int size = record_size(kClassChannels);
  const Scratch<T> records(static_cast<size_t>(num_pairs()) * size);  // the kernels fill all of it
  const Scratch<T> backgrounds(static_cast<size_t>(tiles()) * 3);
  job.records = records.get();
  job.g_background = backgrounds.get();
  const auto kernel = kernels<T>().class_channels_backward;
  for_each_tile_of_classes(num_classes, threads, [&](Query<T>& query, int tile) {
    query.channel_gradients = gradient;
    kernel(job, query, tile);
  });
  reduce(inputs, records.get(), size, to, threads);
}

template <class T>
void Frame<T>::dominant_gaussian(int32_t* indices, int threads) const {
  const Job<T> job = this->job();
  Query<T> query{};
  query.classes = indices;
  const auto kernel = kernels<T>().dominant_gaussian;
  for_each_tile(threads, [&](int tile) { kernel(job, query, tile); });
}

template <class T>
WorkCounts Frame<T>::work_counts(int threads) const {
  const Job<T> job = this->job();
  std::vector<Work> work(tiles());
  const auto kernel = kernels<T>().count;
  for_each_tile(threads, [&](int tile) { work[tile] = kernel(job, tile); });
  WorkCounts counts{0, 0, num_pairs(), 0};
  for (const Work& tile : work) {
    counts.lanes += tile.lanes;
    counts.contributing += tile.contributing;
  }
  for (const int32_t gaussian : bins_.order) counts.box_pairs += tiles_of_usual_box(view_, splats_[gaussian]);
  return counts;
}

template class Frame<float>;
template class Frame<double>;

}  // namespace beags
