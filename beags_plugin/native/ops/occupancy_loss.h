// Computes the occupancy loss (method, section 6; E9) with its gradients, in one pass over the Gaussians.
#pragma once

#include "ops/kernels.h"

namespace beags {
namespace ops {

struct OccupancyResult {
  double value;
  int64_t active;  // Gaussians that had to be sampled
};

// Fills all gradients that are not null.
template <class T>
OccupancyResult occupancy_loss(const OccupancyJob<T>& job, int64_t count, int threads);

}  // namespace ops
}  // namespace beags
