// Kernels with a race and without one: scripts/sanitize.sh asks whether the thread sanitizer tells them apart.
// race_in_kernel barrier|none|blocks|atomic
#include <cstring>

#include "cuda/platform.h"

namespace {

constexpr int kThreads = 64;

// Each thread reads what its neighbour wrote; without the barrier, before or after that.
void rotate(bool barrier, int* values) {
  __shared__ int shared[kThreads];
  const int thread = static_cast<int>(threadIdx.x);
  values += blockIdx.x * kThreads;
  shared[thread] = values[thread];
  if (barrier) __syncthreads();
  values[thread] = shared[(thread + 1) % kThreads];
}

// All blocks add to one number.
void count(bool atomic, int* values) {
  if (threadIdx.x != 0) return;
  if (atomic) {
    atomicAdd(values, 1);
  } else {
    ++*values;
  }
}

}  // namespace

int main(int, char** arguments) {
  int values[3 * kThreads] = {};
  const bool right = !std::strcmp(arguments[1], "barrier") || !std::strcmp(arguments[1], "atomic");
  const bool blocks = !std::strcmp(arguments[1], "blocks") || !std::strcmp(arguments[1], "atomic");
  if (blocks) {
    BEAGS_LAUNCH(count, 3, kThreads, nullptr, right, values);
    return values[0] != 3;
  }
  BEAGS_LAUNCH(rotate, 3, kThreads, nullptr, right, values);
  return 0;
}
