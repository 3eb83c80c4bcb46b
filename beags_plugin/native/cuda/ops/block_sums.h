// Sums in float64 and in a fixed order: over a block's threads, then over the blocks.
#pragma once

#include "cuda/platform.h"

namespace beags {
namespace cuda {

constexpr int kSumThreads = 1024;

// Replaces each value by its sum over the block's threads. Call it once in a kernel.
template <int kThreads, int kEach>
BEAGS_DEVICE void block_sums(double (&values)[kEach]) {
  constexpr int kWarps = kThreads / kWarpThreads;
  __shared__ double sums[kWarps][kEach];
  const int warp = static_cast<int>(threadIdx.x) / kWarpThreads;
  for (double& value : values) value = warp_sum(value);
  if (threadIdx.x % kWarpThreads == 0) {
    for (int k = 0; k < kEach; ++k) sums[warp][k] = values[k];
  }
  __syncthreads();
  for (int k = 0; k < kEach; ++k) {
    values[k] = 0;
    for (int w = 0; w < kWarps; ++w) values[k] += sums[w][k];
  }
}

// Sums the blocks' results, partial [blocks, kEach], in one block of kSumThreads; all its threads get the sums.
template <int kEach>
BEAGS_DEVICE void sum_of_blocks(int64_t blocks, const double* partial, double (&sums)[kEach]) {
  for (int k = 0; k < kEach; ++k) sums[k] = 0;
  for (int64_t i = threadIdx.x; i < blocks; i += kSumThreads) {
    for (int k = 0; k < kEach; ++k) sums[k] += partial[kEach * i + k];
  }
  block_sums<kSumThreads>(sums);
}

}  // namespace cuda
}  // namespace beags
