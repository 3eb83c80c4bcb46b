#include "ops/normal_consistency.h"

#include <memory>
#include <vector>

#include "ops/two_builds.h"

namespace beags {
namespace ops {

template <class T>
double normal_consistency(NormalJob<T> job, int threads) {
  const OpKernels<T>& kernels = best_table<OpKernels<T>>();
  const std::unique_ptr<T[]> shares(job.g_depth ? new T[4 * static_cast<size_t>(job.width) * job.height] : nullptr);
  std::vector<double> sums(job.height);
  job.shares = shares.get();
  job.sums = sums.data();
#pragma omp parallel num_threads(image_team(job.width, job.height, threads))
  {
#pragma omp for schedule(static)
    for (int row = 0; row < job.height; ++row) kernels.normal(job, row);
    if (job.g_depth) {
#pragma omp for schedule(static)
      for (int row = 0; row < job.height; ++row) kernels.normal_gradient(job, row);
    }
  }
  double total = 0;
  for (const double sum : sums) total += sum;
  return total;
}

template double normal_consistency(NormalJob<float>, int);
template double normal_consistency(NormalJob<double>, int);

}  // namespace ops
}  // namespace beags
