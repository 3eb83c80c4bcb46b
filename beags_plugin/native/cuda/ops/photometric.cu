// Computes L1 and SSIM on a GPU: one pass over the image for the value and the slopes, one for the gradient.
#include "cuda/ops/block_sums.h"
#include "cuda/ops/ops.h"
#include "ops/photometric_terms.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

constexpr int kSide = kPhotometricTile, kHalo = kSide + 2 * kSsimReach;  // pixels; kHalo is what the window reaches
constexpr int kSideThreads = kSide * kSide;

// The tile of a block: its first pixel, and this thread's pixel.
struct PhotometricTile {
  int left, top, column, row, x, y;
  bool inside;

  BEAGS_DEVICE PhotometricTile(int width, int height) {
    const int across = (width + kSide - 1) / kSide, block = static_cast<int>(blockIdx.x);
    left = block % across * kSide;
    top = block / across * kSide;
    column = static_cast<int>(threadIdx.x) % kSide;
    row = static_cast<int>(threadIdx.x) / kSide;
    x = left + column;
    y = top + row;
    inside = x < width && y < height;
  }
};

// Blurs along the rows of maps that are already blurred down the columns.
template <class T, int kMaps>
BEAGS_DEVICE void blur_across(const T (&window)[kSsimWindow], const T (&maps)[kMaps][kSide][kHalo],
                              const PhotometricTile& tile, T (&sums)[kMaps]) {
  for (int m = 0; m < kMaps; ++m) {
    sums[m] = 0;
    for (int k = 0; k < kSsimWindow; ++k) sums[m] = fused(window[k], maps[m][tile.row][tile.column + k], sums[m]);
  }
}

template <class T>
__global__ void __launch_bounds__(kSideThreads) photometric_kernel(PhotometricJob<T> job) {
  __shared__ T pictures[2][kHalo][kHalo * kChannels];  // zeros outside the image
  __shared__ T down[4][kSide][kHalo];
  const PhotometricTile tile(job.width, job.height);
  const int64_t line = static_cast<int64_t>(job.width) * kChannels, map = job.height * line;
  for (int i = threadIdx.x; i < kHalo * kHalo * kChannels; i += kSideThreads) {
    const int row = i / (kHalo * kChannels), number = i % (kHalo * kChannels), y = tile.top + row - kSsimReach;
    const int64_t x = (tile.left - kSsimReach) * kChannels + number;
    const bool inside = y >= 0 && y < job.height && x >= 0 && x < line;
    pictures[0][row][number] = inside ? job.image[y * line + x] : T(0);
    pictures[1][row][number] = inside ? job.reference[y * line + x] : T(0);
  }
  __syncthreads();
  double sums[2] = {};
  for (int c = 0; c < kChannels; ++c) {
    for (int i = threadIdx.x; i < kSide * kHalo; i += kSideThreads) {
      const int row = i / kHalo, column = i % kHalo;
      T x = 0, y = 0, squares = 0, product = 0;
      for (int k = 0; k < kSsimWindow; ++k) {
        const T a = pictures[0][row + k][column * kChannels + c], b = pictures[1][row + k][column * kChannels + c];
        const T wa = job.window[k] * a, wb = job.window[k] * b;
        x += wa;
        y += wb;
        squares = fused(wa, a, fused(wb, b, squares));
        product = fused(wa, b, product);
      }
      down[0][row][column] = x;
      down[1][row][column] = y;
      down[2][row][column] = squares;
      down[3][row][column] = product;
    }
    __syncthreads();
    if (tile.inside) {
      T blurred[4];
      blur_across(job.window, down, tile, blurred);
      const auto terms = ssim_terms(blurred[0], blurred[1], blurred[2], blurred[3], job.c1, job.c2);
      const int number = (tile.column + kSsimReach) * kChannels + c;
      const T difference = pictures[0][tile.row + kSsimReach][number] - pictures[1][tile.row + kSsimReach][number];
      sums[0] += difference < 0 ? -difference : difference;
      sums[1] += terms.index;
      if (job.slopes) {
        T* to = job.slopes + tile.y * line + tile.x * kChannels + c;
        to[0] = terms.by_mean;
        to[map] = terms.by_squares;
        to[2 * map] = terms.by_product;
      }
    }
    __syncthreads();
  }
  block_sums<kSideThreads>(sums);
  if (threadIdx.x == 0) {
    for (int k = 0; k < 2; ++k) job.sums[2 * static_cast<int64_t>(blockIdx.x) + k] = sums[k];
  }
}

// As in the CPU's kernel, the backward is the same blur.
template <class T>
__global__ void __launch_bounds__(kSideThreads) photometric_gradient_kernel(PhotometricJob<T> job) {
  __shared__ T slopes[3][kHalo][kHalo];
  __shared__ T down[3][kSide][kHalo];
  const PhotometricTile tile(job.width, job.height);
  const int64_t line = static_cast<int64_t>(job.width) * kChannels, map = job.height * line;
  for (int c = 0; c < kChannels; ++c) {
    for (int i = threadIdx.x; i < kHalo * kHalo; i += kSideThreads) {
      const int row = i / kHalo, column = i % kHalo, y = tile.top + row - kSsimReach,
                x = tile.left + column - kSsimReach;
      const bool inside = y >= 0 && y < job.height && x >= 0 && x < job.width;
      for (int m = 0; m < 3; ++m) {
        slopes[m][row][column] = inside ? job.slopes[m * map + y * line + x * kChannels + c] : T(0);
      }
    }
    __syncthreads();
    for (int i = threadIdx.x; i < kSide * kHalo; i += kSideThreads) {
      const int row = i / kHalo, column = i % kHalo;
      for (int m = 0; m < 3; ++m) {
        T sum = 0;
        for (int k = 0; k < kSsimWindow; ++k) sum = fused(job.window[k], slopes[m][row + k][column], sum);
        down[m][row][column] = sum;
      }
    }
    __syncthreads();
    if (tile.inside) {
      T blurred[3];
      blur_across(job.window, down, tile, blurred);
      const int64_t at = tile.y * line + tile.x * kChannels + c;
      const T x = job.image[at], y = job.reference[at], sign = x > y ? T(1) : x < y ? T(-1) : T(0);
      const T similar = blurred[0] + T(2) * x * blurred[1] + y * blurred[2];
      job.gradient[at] = job.l1_scale * sign + job.ssim_scale * similar;
    }
    // No barrier is needed: the next channel's slopes may be loaded meanwhile, and `down` is written after the next
    // barrier.
  }
}

template <class T>
__global__ void __launch_bounds__(kSumThreads)
    photometric_value_kernel(int64_t blocks, PhotometricJob<T> job, double offset, T* value) {
  double sums[2];
  sum_of_blocks(blocks, job.sums, sums);
  if (threadIdx.x == 0) *value = static_cast<T>(offset + job.l1_scale * sums[0] + job.ssim_scale * sums[1]);
}

}  // namespace

template <class T>
void photometric(const PhotometricJob<T>& job, double offset, T* value, Stream stream) {
  const int64_t blocks = blocks_for(job.width, kSide) * blocks_for(job.height, kSide);
  const auto kernel = photometric_kernel<T>, gradient = photometric_gradient_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks, kSideThreads, stream, job);
  if (job.gradient) BEAGS_LAUNCH(gradient, blocks, kSideThreads, stream, job);
  const auto finish = photometric_value_kernel<T>;
  BEAGS_LAUNCH(finish, 1, kSumThreads, stream, blocks, job, offset, value);
}

template void photometric(const PhotometricJob<float>&, double, float*, Stream);
template void photometric(const PhotometricJob<double>&, double, double*, Stream);

}  // namespace cuda
}  // namespace beags
