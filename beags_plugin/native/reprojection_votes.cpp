#include "reprojection_votes.h"

#include <algorithm>
#include <cmath>

#include "op_kernels.h"
#include "two_builds.h"

namespace beags {
namespace ops {
namespace {

// The class with most votes, the share of its votes; a tie or no vote leaves the label.
void decide(const uint32_t* votes, int num_classes, int32_t* label, float* confidence) {
  uint32_t most = 0, total = 0;
  int winner = 0, leaders = 0;
  for (int c = 0; c < num_classes; ++c) {
    total += votes[c];
    if (votes[c] > most) {
      most = votes[c];
      winner = c;
      leaders = 1;
    } else if (votes[c] == most) {
      ++leaders;
    }
  }
  if (most > 0 && leaders == 1) *label = winner;
  *confidence = static_cast<float>(most) / static_cast<float>(std::max(total, 1u));
}

// Row y of a view's labels, as the kernels read them; `wide` is where a row of bytes is widened.
template <class T>
const int32_t* row_labels(const VotingView<T>& view, int y, std::vector<int32_t>* wide) {
  const int64_t row = static_cast<int64_t>(y) * view.width;
  if (view.labels) return view.labels + row;
  wide->resize(view.width);
  for (int x = 0; x < view.width; ++x) {
    const uint8_t label = view.short_labels[row + x];
    (*wide)[x] = label == kShortIgnore ? -1 : label;
  }
  return wide->data();
}

}  // namespace

template <class T>
void reprojection_votes(const std::vector<VotingView<T>>& views, const std::vector<VotedView<T>>& targets,
                        int num_classes, double tau, int threads) {
  const int64_t count = static_cast<int64_t>(targets.size());
  const int team = static_cast<int>(std::max<int64_t>(1, std::min<int64_t>(threads, count)));
#pragma omp parallel num_threads(team)
  {
    std::vector<uint32_t> votes;
    std::vector<int32_t> wide;
    // Determinism: a target's votes are counted by one thread; sums of integers have no order anyway.
#pragma omp for schedule(dynamic, 1)
    for (int64_t t = 0; t < count; ++t) {
      const VotedView<T>& target = targets[t];
      const VotingView<T>& seen = views[target.view];
      const int64_t pixels = static_cast<int64_t>(seen.height) * seen.width;
      votes.assign(pixels * num_classes, 0);
      CastJob<T> job{};
      job.target_width = seen.width;
      job.target_height = seen.height;
      job.target_depth = std::isinf(tau) ? nullptr : seen.depth;
      job.tau = static_cast<T>(tau);
      job.num_classes = num_classes;
      job.votes = votes.data();
      for (size_t v = 0; v < views.size(); ++v) {
        const VotingView<T>& view = views[v];
        if (!view.labels && !view.short_labels) continue;
        std::copy_n(target.maps + 12 * v, 9, job.a);
        std::copy_n(target.maps + 12 * v + 9, 3, job.b);
        job.source_width = view.width;
        for (int y = 0; y < view.height; ++y) {
          const int64_t row = static_cast<int64_t>(y) * view.width;
          best_table<OpKernels<T>>().cast_row(job, y, view.depth + row, row_labels(view, y, &wide));
        }
      }
      for (int64_t pixel = 0; pixel < pixels; ++pixel) {
        decide(votes.data() + pixel * num_classes, num_classes, target.labels + pixel, target.confidence + pixel);
      }
    }
  }
}

#define BEAGS_INSTANTIATE(T)                                                                                         \
  template void reprojection_votes(const std::vector<VotingView<T>>&, const std::vector<VotedView<T>>&, int, double, \
                                   int);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace ops
}  // namespace beags
