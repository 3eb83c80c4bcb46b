#include "image_losses.h"

#include <memory>
#include <vector>

#include "two_builds.h"

namespace beags {
namespace ops {
namespace {

constexpr int64_t kTeamPixels = 16384;  // a team costs tens of microseconds, a pixel some ten nanoseconds

int team(int width, int height, int threads) {
  return static_cast<int64_t>(width) * height < kTeamPixels ? 1 : threads;
}

}  // namespace

template <class T>
PhotometricSums photometric(PhotometricJob<T> job, int threads) {
  const ImageKernels<T>& kernels = best_table<ImageKernels<T>>();
  const int64_t numbers = static_cast<int64_t>(job.width) * job.height * kChannels;
  const std::unique_ptr<T[]> slopes(job.gradient ? new T[3 * numbers] : nullptr);
  std::vector<double> sums(2 * static_cast<size_t>(job.height));
  job.slopes = slopes.get();
  job.sums = sums.data();
#pragma omp parallel num_threads(team(job.width, job.height, threads))
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

template <class T>
double normal_consistency(NormalJob<T> job, int threads) {
  const ImageKernels<T>& kernels = best_table<ImageKernels<T>>();
  const std::unique_ptr<T[]> shares(job.g_depth ? new T[4 * static_cast<size_t>(job.width) * job.height] : nullptr);
  std::vector<double> sums(job.height);
  job.shares = shares.get();
  job.sums = sums.data();
#pragma omp parallel num_threads(team(job.width, job.height, threads))
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

template PhotometricSums photometric(PhotometricJob<float>, int);
template PhotometricSums photometric(PhotometricJob<double>, int);
template double normal_consistency(NormalJob<float>, int);
template double normal_consistency(NormalJob<double>, int);

}  // namespace ops
}  // namespace beags
