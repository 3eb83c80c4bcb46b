// Computes normal consistency on a GPU: one pass over the image for the value and the slopes, one for the gradient.
#include "cuda/ops/block_sums.h"
#include "cuda/ops/ops.h"
#include "ops/normal_consistency_terms.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

template <class T>
__global__ void __launch_bounds__(kNormalThreads) normal_kernel(NormalJob<T> job) {
  const int64_t pixels = static_cast<int64_t>(job.width) * job.height;
  const int64_t at = static_cast<int64_t>(blockIdx.x) * kNormalThreads + threadIdx.x;
  double error[1] = {};
  if (at < pixels) {
    const int x = static_cast<int>(at % job.width), y = static_cast<int>(at / job.width);
    NormalTerms<T> terms = {};  // The image's border has no error.
    if (x > 0 && x + 1 < job.width && y > 0 && y + 1 < job.height) {
      const T* d = job.depth + at;
      const Depths<T> depths = {d[0], d[1], d[-1], d[job.width], d[-job.width]};
      const Triple<T> n = {job.normal[3 * at], job.normal[3 * at + 1], job.normal[3 * at + 2]};
      terms = normal_terms(job, static_cast<T>(x), y, depths, n, job.alpha[at]);
    }
    error[0] = terms.error;
    if (job.shares) {
      for (int i = 0; i < 4; ++i) job.shares[i * pixels + at] = terms.shares[i];
      job.g_normal[3 * at] = terms.g_normal.x;
      job.g_normal[3 * at + 1] = terms.g_normal.y;
      job.g_normal[3 * at + 2] = terms.g_normal.z;
    }
  }
  block_sums<kNormalThreads>(error);
  if (threadIdx.x == 0) job.sums[blockIdx.x] = error[0];
}

template <class T>
__global__ void __launch_bounds__(kNormalThreads) normal_gradient_kernel(NormalJob<T> job) {
  const int64_t pixels = static_cast<int64_t>(job.width) * job.height;
  const int64_t at = static_cast<int64_t>(blockIdx.x) * kNormalThreads + threadIdx.x;
  if (at < pixels) job.g_depth[at] = gathered_shares(job, at);
}

template <class T>
__global__ void __launch_bounds__(kSumThreads) normal_value_kernel(int64_t blocks, NormalJob<T> job, T* value) {
  double sums[1];
  sum_of_blocks(blocks, job.sums, sums);
  if (threadIdx.x == 0) *value = static_cast<T>(job.scale * sums[0]);
}

}  // namespace

template <class T>
void normal_consistency(const NormalJob<T>& job, T* value, Stream stream) {
  const int64_t blocks = blocks_for(static_cast<int64_t>(job.width) * job.height, kNormalThreads);
  const auto kernel = normal_kernel<T>, gradient = normal_gradient_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks, kNormalThreads, stream, job);
  if (job.g_depth) BEAGS_LAUNCH(gradient, blocks, kNormalThreads, stream, job);
  const auto finish = normal_value_kernel<T>;
  BEAGS_LAUNCH(finish, 1, kSumThreads, stream, blocks, job, value);
}

template void normal_consistency(const NormalJob<float>&, float*, Stream);
template void normal_consistency(const NormalJob<double>&, double*, Stream);

}  // namespace cuda
}  // namespace beags
