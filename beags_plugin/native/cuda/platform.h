// Provides what the kernels need of CUDA, or of its emulation on the CPU (BEAGS_CUDA_EMULATION).
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>

#if defined(BEAGS_CUDA_EMULATION)

#include "cuda/emulation/host_emulation.h"

namespace beags {
namespace cuda {
using Stream = void*;
inline void fill_bytes(void* to, int value, size_t bytes, Stream) {
  if (bytes) std::memset(to, value, bytes);
}
template <class V>
V load_now(const V* at) {
  return __atomic_load_n(at, __ATOMIC_RELAXED);
}
}  // namespace cuda
}  // namespace beags
// Launches `kernel`, a plain name, on `blocks` blocks (0 is allowed).
#define BEAGS_LAUNCH(kernel, blocks, threads, stream, ...) \
  ((void)(stream), ::beags::emulation::launch((blocks), (threads), [&] { kernel(__VA_ARGS__); }))

#else

#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

namespace beags {
namespace cuda {
using Stream = cudaStream_t;
inline void check(cudaError_t status, const char* what) {
  if (status != cudaSuccess) throw std::runtime_error(std::string(what) + ": " + cudaGetErrorString(status));
}
inline void fill_bytes(void* to, int value, size_t bytes, Stream stream) {
  if (bytes) check(cudaMemsetAsync(to, value, bytes, stream), "filling memory");
}
// Reads a value that other threads may be changing by atomic operations.
template <class V>
__device__ __forceinline__ V load_now(const V* at) {
  return *static_cast<const volatile V*>(at);
}
}  // namespace cuda
}  // namespace beags
#define BEAGS_DEVICE __device__ __forceinline__
#define BEAGS_LAUNCH(kernel, blocks, threads, stream, ...)                            \
  do {                                                                                \
    if ((blocks) > 0) {                                                               \
      kernel<<<static_cast<unsigned>(blocks), (threads), 0, (stream)>>>(__VA_ARGS__); \
      ::beags::cuda::check(cudaGetLastError(), "launching " #kernel);                 \
    }                                                                                 \
  } while (false)

#endif

namespace beags {
namespace cuda {

constexpr unsigned kWholeWarp = 0xFFFFFFFFu;
constexpr int kWarpThreads = 32;
constexpr int kBlockThreads = 256;  // threads of a block in kernels with one item per thread

inline int64_t blocks_for(int64_t items, int threads = kBlockThreads) { return (items + threads - 1) / threads; }

BEAGS_DEVICE float fused(float a, float b, float c) { return fmaf(a, b, c); }
BEAGS_DEVICE double fused(double a, double b, double c) { return fma(a, b, c); }
BEAGS_DEVICE float power_of_two(float x) { return exp2f(x); }
BEAGS_DEVICE double power_of_two(double x) { return exp2(x); }
template <class T>
BEAGS_DEVICE T least(T a, T b) {
  return b < a ? b : a;
}

// Returns the sum over a warp, to every lane.
template <class V>
BEAGS_DEVICE V warp_sum(V value) {
  for (int step = kWarpThreads / 2; step > 0; step /= 2) value += __shfl_xor_sync(kWholeWarp, value, step);
  return value;
}

}  // namespace cuda
}  // namespace beags
