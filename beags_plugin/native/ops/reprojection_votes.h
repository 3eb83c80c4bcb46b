// Votes on the labels of some views by the lifted pixels of all (method, section 2; E5).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "ops/kernels.h"
#include "simd/device.h"

namespace beags {
namespace ops {

// A view that votes or is voted on: [height, width] images.
template <class T>
struct VotingView {
  int height, width;
  const T* depth;
  const int32_t* labels;        // null: no mask, or
  const uint8_t* short_labels;  // labels of a byte per pixel, in which kShortIgnore does not vote; null: none
};

constexpr uint8_t kShortIgnore = 255;

// Returns the label that a pixel of a view with a mask votes for; -1: none.
template <class T>
BEAGS_HD inline int32_t label_of(const VotingView<T>& view, int64_t pixel) {
  if (view.labels) return view.labels[pixel];
  const uint8_t label = view.short_labels[pixel];
  return label == kShortIgnore ? -1 : label;
}

template <class T>
struct VotedView {
  int view;           // index of the view whose pixels are voted on
  const T* maps;      // [views, 12]: A row-major, then b, from every view to this one (see CastJob)
  int32_t* labels;    // [height, width]; on entry the original labels, kept where there is no clear winner
  float* confidence;  // [height, width]
};

// Makes the part of a job that all votes for a target share. votes: its counters.
template <class T>
CastJob<T> cast_job(const VotingView<T>& target, int num_classes, double tau, uint32_t* votes) {
  CastJob<T> job{};
  job.target_width = target.width;
  job.target_height = target.height;
  job.target_depth = std::isinf(tau) ? nullptr : target.depth;
  job.tau = static_cast<T>(tau);
  job.num_classes = num_classes;
  job.votes = votes;
  return job;
}

// Sets the next view that votes. map: from it to the target.
template <class T>
void set_source(CastJob<T>& job, const VotingView<T>& source, const T* map) {
  std::copy_n(map, 9, job.a);
  std::copy_n(map + 9, 3, job.b);
  job.source_width = source.width;
}

// Votes on all targets. Threads share the targets; each thread keeps one view's counters.
template <class T>
void reprojection_votes(const std::vector<VotingView<T>>& views, const std::vector<VotedView<T>>& targets,
                        int num_classes, double tau, int threads);

}  // namespace ops
}  // namespace beags
