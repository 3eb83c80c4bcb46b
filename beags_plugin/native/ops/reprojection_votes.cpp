#include "ops/reprojection_votes.h"

#include <algorithm>

#define BEAGS_ISA baseline
#include "ops/reprojection_votes_terms.h"
#include "ops/two_builds.h"

namespace beags {
namespace ops {
namespace {

// Returns row y of a view's labels as the kernels read them; `wide` stores a widened row of bytes.
template <class T>
const int32_t* row_labels(const VotingView<T>& view, int y, std::vector<int32_t>* wide) {
  const int64_t row = static_cast<int64_t>(y) * view.width;
  if (view.labels) return view.labels + row;
  wide->resize(view.width);
  for (int x = 0; x < view.width; ++x) (*wide)[x] = label_of(view, row + x);
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
    // Determinism: one thread counts a target's votes, and sums of integers do not depend on their order.
#pragma omp for schedule(dynamic, 1)
    for (int64_t t = 0; t < count; ++t) {
      const VotedView<T>& target = targets[t];
      const VotingView<T>& seen = views[target.view];
      const int64_t pixels = static_cast<int64_t>(seen.height) * seen.width;
      votes.assign(pixels * num_classes, 0);
      CastJob<T> job = cast_job(seen, num_classes, tau, votes.data());
      for (size_t v = 0; v < views.size(); ++v) {
        const VotingView<T>& view = views[v];
        if (!view.labels && !view.short_labels) continue;
        set_source(job, view, target.maps + 12 * v);
        for (int y = 0; y < view.height; ++y) {
          const int64_t row = static_cast<int64_t>(y) * view.width;
          best_table<OpKernels<T>>().cast_row(job, y, view.depth + row, row_labels(view, y, &wide));
        }
      }
      for (int64_t pixel = 0; pixel < pixels; ++pixel) {
        baseline::decide_by_votes(votes.data() + pixel * num_classes, num_classes, target.labels + pixel,
                                  target.confidence + pixel);
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
