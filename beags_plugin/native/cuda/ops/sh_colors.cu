// Computes colours from spherical harmonics, one thread a Gaussian (method, section 1).
#include "cuda/ops/ops.h"
#include "ops/sh_colors_terms.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

constexpr int kThreads = 128;

template <int kDegree, class T>
__global__ void colors_kernel(ColorJob<T> job, int64_t count) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1);
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  T b[kBases];
  basis<kDegree>(direction(job, i), [&](int k, T value) { b[k] = value; });
  const T *dc = job.dc + 3 * i, *rest = job.rest + i * job.num_rest * 3;
  uint8_t clamped = 0;
  for (int c = 0; c < 3; ++c) {
    T value = b[0] * dc[c];
    for (int k = 1; k < kBases; ++k) value += b[k] * rest[3 * (k - 1) + c];
    value += T(0.5);
    clamped |= static_cast<uint8_t>((value < 0) << c);
    job.colors[3 * i + c] = value < 0 ? T(0) : value;  // NaN remains NaN.
  }
  job.clamped[i] = clamped;
}

template <class T>
BEAGS_DEVICE void add(DirectionGradient<T>& sum, const DirectionGradient<T>& more) {
  sum.x += more.x;
  sum.y += more.y;
  sum.z += more.z;
}

// A block's coefficients of `rest` pass through shared memory, and then their gradients, in the same place. A
// Gaussian's row is long: if each thread read or wrote its own, a warp would touch 32 lines of memory at once.
template <int kDegree, class T>
__global__ void colors_backward_kernel(ColorJob<T> job, int64_t count) {
  constexpr int kBases = (kDegree + 1) * (kDegree + 1), kUsed = 3 * (kBases - 1);
  constexpr int kStride = kUsed | 1;  // With an odd stride a column covers all banks.
  __shared__ T rows[kThreads * kStride];
  static_assert(sizeof(rows) <= 48 << 10, "no more can be had without asking");
  const int row = 3 * job.num_rest, threads = static_cast<int>(blockDim.x), me = static_cast<int>(threadIdx.x);
  const int64_t first = static_cast<int64_t>(blockIdx.x) * threads, i = first + me;
  const int all = static_cast<int>(least<int64_t>(threads, count - first)) * row;
  const bool moves = kDegree > 0 && job.g_means;
  if (moves) {
    for (int k = me; k < all; k += threads) {
      if (k % row < kUsed) rows[k / row * kStride + k % row] = job.rest[first * row + k];
    }
    __syncthreads();
  }
  if (i < count) {
    const Direction<T> d = direction(job, i);
    T b[kBases], g[3];
    T* mine = rows + me * kStride;
    basis<kDegree>(d, [&](int k, T value) { b[k] = value; });
    for (int c = 0; c < 3; ++c) g[c] = job.clamped[i] >> c & 1 ? T(0) : job.g_colors[3 * i + c];
    if (job.g_dc) {
      for (int c = 0; c < 3; ++c) job.g_dc[3 * i + c] = b[0] * g[c];
    }
    if (moves) {
      T g_basis[16] = {};
      for (int k = 1; k < kBases; ++k) {  // The first function is constant.
        const T* sh = mine + 3 * (k - 1);
        g_basis[k] = g[0] * sh[0] + g[1] * sh[1] + g[2] * sh[2];
      }
      const auto g_of = [&](int k) { return g_basis[k]; };
      DirectionGradient<T> sum = basis_backward<1>(d, g_of);
      if constexpr (kDegree >= 2) add(sum, basis_backward<2>(d, g_of));
      if constexpr (kDegree >= 3) add(sum, basis_backward<3>(d, g_of));
      to_mean(d, sum, job.g_means + 3 * i);
    }
    for (int k = 1; k < kBases; ++k) {
      for (int c = 0; c < 3; ++c) mine[3 * (k - 1) + c] = b[k] * g[c];
    }
  }
  if (!job.g_rest) return;
  __syncthreads();
  for (int k = me; k < all; k += threads) {
    job.g_rest[first * row + k] = k % row < kUsed ? rows[k / row * kStride + k % row] : T(0);
  }
}

}  // namespace

template <class T>
void sh_colors(const ColorJob<T>& job, int64_t count, Stream stream) {
  auto kernel = colors_kernel<0, T>;
  if (job.degree == 1) kernel = colors_kernel<1, T>;
  if (job.degree == 2) kernel = colors_kernel<2, T>;
  if (job.degree == 3) kernel = colors_kernel<3, T>;
  BEAGS_LAUNCH(kernel, blocks_for(count, kThreads), kThreads, stream, job, count);
}

template <class T>
void sh_colors_backward(const ColorJob<T>& job, int64_t count, Stream stream) {
  auto kernel = colors_backward_kernel<0, T>;
  if (job.degree == 1) kernel = colors_backward_kernel<1, T>;
  if (job.degree == 2) kernel = colors_backward_kernel<2, T>;
  if (job.degree == 3) kernel = colors_backward_kernel<3, T>;
  BEAGS_LAUNCH(kernel, blocks_for(count, kThreads), kThreads, stream, job, count);
}

#define BEAGS_INSTANTIATE(T)                                    \
  template void sh_colors(const ColorJob<T>&, int64_t, Stream); \
  template void sh_colors_backward(const ColorJob<T>&, int64_t, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
