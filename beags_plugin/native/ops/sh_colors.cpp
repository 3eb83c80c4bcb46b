#include "ops/sh_colors.h"

#include <algorithm>

#include "ops/two_builds.h"

namespace beags {
namespace ops {
namespace {

template <class T>
void run(void (*kernel)(const ColorJob<T>&, int64_t, int64_t), const ColorJob<T>& job, int64_t count, int threads) {
  const int64_t blocks = (count + kColorBlock - 1) / kColorBlock;
  const int team = count < 8000 ? 1 : threads;  // A Gaussian takes some ten nanoseconds, a team tens of microseconds.
#pragma omp parallel for num_threads(team) schedule(static)
  for (int64_t block = 0; block < blocks; ++block) {
    kernel(job, block * kColorBlock, std::min((block + 1) * kColorBlock, count));
  }
}

}  // namespace

template <class T>
void sh_colors(const ColorJob<T>& job, int64_t count, int threads) {
  run(best_table<OpKernels<T>>().colors, job, count, threads);
}

template <class T>
void sh_colors_backward(const ColorJob<T>& job, int64_t count, int threads) {
  run(best_table<OpKernels<T>>().colors_backward, job, count, threads);
}

#define BEAGS_INSTANTIATE(T)                                 \
  template void sh_colors(const ColorJob<T>&, int64_t, int); \
  template void sh_colors_backward(const ColorJob<T>&, int64_t, int);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace ops
}  // namespace beags
