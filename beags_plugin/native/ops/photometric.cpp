#include "ops/photometric.h"

#include <memory>
#include <vector>

#include "ops/two_builds.h"

namespace beags {
namespace ops {

template <class T>
PhotometricSums photometric(PhotometricJob<T> job, int threads) {
  const OpKernels<T>& kernels = best_table<OpKernels<T>>();
  const int64_t numbers = static_cast<int64_t>(job.width) * job.height * kChannels;
  const std::unique_ptr<T[]> slopes(job.gradient ? new T[3 * numbers] : nullptr);
  std::vector<double> sums(2 * static_cast<size_t>(job.height));
  job.slopes = slopes.get();
  job.sums = sums.data();
#pragma omp parallel num_threads(image_team(job.width, job.height, threads))
  {
    const std::unique_ptr<T[]> scratch(new T[kernels.photometric_scratch(job.width)]);
#pragma omp for schedule(static)
    for (int row = 0; row < job.height; ++row) kernels.photometric(job, row, scratch.get());
    if (job.gradient) {
#pragma omp for schedule(static)
      for (int row = 0; row < job.height; ++row) kernels.photometric_gradient(job, row, scratch.get());
    }
  }
  PhotometricSums result{};
  for (int row = 0; row < job.height; ++row) {
    result.absolute += sums[2 * row];
    result.similar += sums[2 * row + 1];
  }
  return result;
}

template PhotometricSums photometric(PhotometricJob<float>, int);
template PhotometricSums photometric(PhotometricJob<double>, int);

}  // namespace ops
}  // namespace beags
