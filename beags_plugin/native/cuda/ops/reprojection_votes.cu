// Counts pairwise votes (method, section 2; E5): one thread a source pixel, then one thread a target pixel. Votes are
// whole numbers, whose sums do not depend on their order: the result equals the CPU's bit for bit.
#include "cuda/ops/ops.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

template <class T>
__global__ void cast_kernel(CastJob<T> job, VotingView<T> view) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= static_cast<int64_t>(view.width) * view.height) return;
  const int32_t label = label_of(view, i);
  if (label < 0 || label >= job.num_classes) return;
  const T x = static_cast<T>(i % view.width) + T(0.5), y = static_cast<T>(i / view.width) + T(0.5), d = view.depth[i];
  const Projected<T> to = project_pixel<T, T>(job, x, y, d);
  if (!lands_in_target<T, T>(job, to, d)) return;
  int32_t column = static_cast<int32_t>(to.hx / to.z), line = static_cast<int32_t>(to.hy / to.z);
  column -= column == job.target_width;  // The quotient may round up to the border itself.
  line -= line == job.target_height;
  const int64_t pixel = static_cast<int64_t>(line) * job.target_width + column;
  if (seen_in_target(job, pixel, to.z)) atomicAdd(job.votes + pixel * job.num_classes + label, 1u);
}

__global__ void decide_kernel(int64_t pixels, int num_classes, const uint32_t* votes, int32_t* labels,
                              float* confidence) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i < pixels) decide_by_votes(votes + i * num_classes, num_classes, labels + i, confidence + i);
}

}  // namespace

template <class T>
void reprojection_votes(const std::vector<VotingView<T>>& views, const std::vector<VotedView<T>>& targets,
                        int num_classes, double tau, uint32_t* votes, Stream stream) {
  const auto cast = cast_kernel<T>;
  for (const VotedView<T>& target : targets) {
    const VotingView<T>& seen = views[target.view];
    const int64_t pixels = static_cast<int64_t>(seen.height) * seen.width;
    fill_bytes(votes, 0, static_cast<size_t>(pixels) * num_classes * sizeof(uint32_t), stream);
    CastJob<T> job = cast_job(seen, num_classes, tau, votes);
    for (size_t v = 0; v < views.size(); ++v) {
      const VotingView<T>& view = views[v];
      if (!view.labels && !view.short_labels) continue;
      set_source(job, view, target.maps + 12 * v);
      const int64_t blocks = blocks_for(static_cast<int64_t>(view.width) * view.height);
      BEAGS_LAUNCH(cast, blocks, kBlockThreads, stream, job, view);
    }
    BEAGS_LAUNCH(decide_kernel, blocks_for(pixels), kBlockThreads, stream, pixels, num_classes, votes, target.labels,
                 target.confidence);
  }
}

#define BEAGS_INSTANTIATE(T)                                                                                         \
  template void reprojection_votes(const std::vector<VotingView<T>>&, const std::vector<VotedView<T>>&, int, double, \
                                   uint32_t*, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
