// Answers queries without gradients (sections 3 and 5).
#include "cuda/rasterizer/hits.h"

namespace beags {
namespace cuda {
namespace {

// Sums class contributions (E6). Weights are added as whole numbers, so that the order of atomic additions has no
// effect.
template <class T>
__global__ void __launch_bounds__(kTilePixels)
    class_contributions_kernel(TileJob<T> job, const int32_t* labels, int num_classes, unsigned long long* sums) {
  const Place<T> place(job);
  Walk<T> walk;
  const int32_t label = place.inside ? labels[place.at] : -1;
  const bool counts = label >= 0 && label < num_classes;
  const int64_t start = job.bins.tile_start[place.tile];
  composite(job, place, walk, [&](int k, const Splat<T>&, const Hit<T>&, T w, T) {
    constexpr double kUnit = static_cast<double>(int64_t(1) << kWeightBits);
    const unsigned long long whole =
        counts && w > T(0) ? static_cast<unsigned long long>(static_cast<double>(w) * kUnit + 0.5) : 0;
    unsigned left = __ballot_sync(kWholeWarp, whole > 0);
    while (left) {  // Each round takes one label of the warp.
      const int32_t next = __shfl_sync(kWholeWarp, label, __ffs(left) - 1);
      const unsigned long long sum = warp_sum(label == next ? whole : 0ull);
      if (place.lane == 0) {
        const int64_t gaussian = job.bins.pair_gaussian[job.bins.pairs[start + k]];
        atomicAdd(sums + gaussian * num_classes + next, sum);
      }
      left &= ~__ballot_sync(kWholeWarp, label == next);
    }
  });
}

constexpr int kClassesAtOnce = 8;
constexpr int kClassWords = (kIgnore + 31) / 32;

// Finds each pixel's class: that of the largest sum of w, the lowest of equals. The tile is walked once for every eight
// of its classes.
template <class T>
__global__ void __launch_bounds__(kTilePixels)
    class_map_kernel(TileJob<T> job, int num_classes, int32_t* classes, T* share) {
  __shared__ uint32_t present[kClassWords];
  const Place<T> place(job);
  Walk<T> walk;
  const int words = (num_classes + 31) / 32;
  for (int i = threadIdx.x; i < words; i += kTilePixels) present[i] = 0;
  __syncthreads();
  const int64_t start = job.bins.tile_start[place.tile], end = job.bins.tile_start[place.tile + 1];
  for (int64_t k = start + threadIdx.x; k < end; k += kTilePixels) {
    const int32_t id = job.bins.splats[job.bins.pair_gaussian[job.bins.pairs[k]]].class_id;
    atomicOr(present + id / 32, uint32_t(1) << id % 32);
  }
  __syncthreads();
  T best = 0;
  int32_t winner = 0;
  int next = 0;  // It is the same in all threads.
  for (;;) {
    int32_t ids[kClassesAtOnce];
    int found = 0;
    while (next < num_classes && found < kClassesAtOnce) {
      const uint32_t rest = present[next / 32] >> next % 32;
      if (!rest) {
        next = (next / 32 + 1) * 32;
        continue;
      }
      next += __ffs(rest) - 1;
      ids[found++] = next++;
    }
    if (!found) break;
    for (int i = found; i < kClassesAtOnce; ++i) ids[i] = -1;
    T sums[kClassesAtOnce] = {};
    walk = Walk<T>();
    composite(job, place, walk, [&](int, const Splat<T>& s, const Hit<T>&, T w, T) {
#pragma unroll
      for (int i = 0; i < kClassesAtOnce; ++i) sums[i] += s.class_id == ids[i] ? w : T(0);
    });
#pragma unroll
    for (int i = 0; i < kClassesAtOnce; ++i) {
      if (sums[i] > best) {
        best = sums[i];
        winner = ids[i];
      }
    }
  }
  if (!place.inside) return;
  classes[place.at] = winner;
  share[place.at] = best > T(0) ? best / (T(1) - walk.transmittance) : T(0);
}

// Finds each pixel's Gaussian with the largest w, the nearer of equals.
template <class T>
__global__ void __launch_bounds__(kTilePixels) dominant_gaussian_kernel(TileJob<T> job, int32_t* indices) {
  const Place<T> place(job);
  Walk<T> walk;
  T best = 0;
  int pair = -1;
  composite(job, place, walk, [&](int k, const Splat<T>&, const Hit<T>&, T w, T) {
    if (w > best) {
      best = w;
      pair = k;
    }
  });
  if (!place.inside) return;
  const int64_t start = job.bins.tile_start[place.tile];
  indices[place.at] = pair < 0 ? -1 : job.bins.pair_gaussian[job.bins.pairs[start + pair]];
}

}  // namespace

template <class T>
void class_contributions(const TileJob<T>& job, const int32_t* labels, int num_classes, int64_t* sums, Stream stream) {
  const auto kernel = class_contributions_kernel<T>;
  unsigned long long* unsigned_sums = reinterpret_cast<unsigned long long*>(sums);
  BEAGS_LAUNCH(kernel, job.tiles_x * job.tiles_y, kTilePixels, stream, job, labels, num_classes, unsigned_sums);
}

template <class T>
void class_map(const TileJob<T>& job, int num_classes, int32_t* classes, T* share, Stream stream) {
  const auto kernel = class_map_kernel<T>;
  BEAGS_LAUNCH(kernel, job.tiles_x * job.tiles_y, kTilePixels, stream, job, num_classes, classes, share);
}

template <class T>
void dominant_gaussian(const TileJob<T>& job, int32_t* indices, Stream stream) {
  const auto kernel = dominant_gaussian_kernel<T>;
  BEAGS_LAUNCH(kernel, job.tiles_x * job.tiles_y, kTilePixels, stream, job, indices);
}

#define BEAGS_INSTANTIATE(T)                                                                   \
  template void class_contributions(const TileJob<T>&, const int32_t*, int, int64_t*, Stream); \
  template void class_map(const TileJob<T>&, int, int32_t*, T*, Stream);                       \
  template void dominant_gaussian(const TileJob<T>&, int32_t*, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
