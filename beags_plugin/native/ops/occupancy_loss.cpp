#include "ops/occupancy_loss.h"

#include <algorithm>
#include <vector>

#include "ops/two_builds.h"

namespace beags {
namespace ops {

template <class T>
OccupancyResult occupancy_loss(const OccupancyJob<T>& job, int64_t count, int threads) {
  const int64_t blocks = (count + kOccupancyBlock - 1) / kOccupancyBlock;
  std::vector<OccupancyResult> results(blocks, OccupancyResult{0, 0});
  // A sample takes a few nanoseconds, a team tens of microseconds.
  const int team = count * (job.samples + 20) < 50000 ? 1 : threads;
#pragma omp parallel for num_threads(team) schedule(dynamic, 1)
  for (int64_t block = 0; block < blocks; ++block) {
    const int64_t first = block * kOccupancyBlock, last = std::min(first + kOccupancyBlock, count);
    OccupancyResult result{0, 0};
    result.value = best_table<OpKernels<T>>().occupancy(job, first, last, &result.active);
    results[block] = result;
  }
  // Determinism: blocks are the same for any number of threads, and are summed in order.
  OccupancyResult total{0, 0};
  for (const OccupancyResult& result : results) {
    total.value += result.value;
    total.active += result.active;
  }
  return total;
}

template OccupancyResult occupancy_loss(const OccupancyJob<float>&, int64_t, int);
template OccupancyResult occupancy_loss(const OccupancyJob<double>&, int64_t, int);

}  // namespace ops
}  // namespace beags
