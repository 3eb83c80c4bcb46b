// Looks up points in the visibility voxel grids, one thread a query; see ops/voxel_lookup.cpp.
#include "cuda/ops/ops.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

// Each step is monotonic, as in VisibilityGrid's _scaled.
template <class T>
BEAGS_DEVICE void to_voxels(const Voxels& voxels, const T* point, T* voxel) {
  for (int axis = 0; axis < 3; ++axis) {
    voxel[axis] = floor((point[axis] - static_cast<T>(voxels.origin[axis])) / static_cast<T>(voxels.voxel_size));
  }
}

template <class T>
__global__ void count_kernel(Voxels voxels, int64_t count, const T* points, const int32_t* class_ids, int64_t* out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  T voxel[3];
  to_voxels(voxels, points + 3 * i, voxel);
  int64_t low[3], found = 0;
  const T half = static_cast<T>(kVoxelHalf);
  if (fabs(voxel[0]) < half && fabs(voxel[1]) < half && fabs(voxel[2]) < half) {
    const int sizes[3] = {3, 3, 3};
    for (int axis = 0; axis < 3; ++axis) low[axis] = static_cast<int64_t>(voxel[axis]) - 1;
    found = __popcll(voxel_box(voxels.occupied, class_ids[i], low, sizes) & box_bits(3, 3, 3));
  }
  out[i] = found;
}

template <class T>
__global__ void valid_kernel(Voxels voxels, int64_t count, const T* points, const int32_t* class_ids, bool* out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  T voxel[3];
  to_voxels(voxels, points + 3 * i, voxel);
  out[i] = voxel_member(voxels.valid[0], class_ids[i], voxel);
}

__global__ void hash_kernel(int64_t count, const int32_t* ranks, const Brick* bricks, const BrickRange* classes,
                            Brick* slots) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  const BrickRange range = classes[ranks[i]];
  const Brick brick = bricks[i];
  for (uint64_t at = brick.key * kGolden >> range.shift;; at = (at + 1) & range.mask) {
    Brick& slot = slots[range.first + at];
    const unsigned long long empty = kNoBrick, key = brick.key;
    if (atomicCAS(reinterpret_cast<unsigned long long*>(&slot.key), empty, key) != empty) continue;
    slot.bits = brick.bits;
    return;
  }
}

template <class T>
__global__ void disc_inside_kernel(Voxels voxels, int64_t count, const T* means, const T* axes_u, const T* axes_v,
                                   const int32_t* class_ids, bool* out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= count) return;
  constexpr T kRounding = 16 * (sizeof(T) == 4 ? T(1.1920929e-7) : T(2.220446049250313e-16));
  T low[3], high[3], from[3], to[3];
  for (int axis = 0; axis < 3; ++axis) {
    const T mean = means[3 * i + axis], u = axes_u[3 * i + axis], v = axes_v[3 * i + axis];
    const T origin = static_cast<T>(voxels.origin[axis]);
    const T half = sqrt(u * u + v * v) * (1 + kRounding) + kRounding * (fabs(mean) + fabs(origin));
    low[axis] = mean - half;
    high[axis] = mean + half;
  }
  to_voxels(voxels, low, from);
  to_voxels(voxels, high, to);
  int64_t corner[3];
  int n[3];
  bool inside = false;
  if (small_box(from, to, corner, n)) {
    const uint64_t box = box_bits(n[0], n[1], n[2]);
    inside = (voxel_box(voxels.valid[0], class_ids[i], corner, n) & box) == box;
  }
  out[i] = inside;
}

}  // namespace

template <class T>
void count_occupied(const Voxels& voxels, int64_t count, const T* points, const int32_t* class_ids, int64_t* out,
                    Stream stream) {
  const auto kernel = count_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(count), kBlockThreads, stream, voxels, count, points, class_ids, out);
}

template <class T>
void is_valid(const Voxels& voxels, int64_t count, const T* points, const int32_t* class_ids, bool* out,
              Stream stream) {
  const auto kernel = valid_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(count), kBlockThreads, stream, voxels, count, points, class_ids, out);
}

template <class T>
void disc_inside(const Voxels& voxels, int64_t count, const T* means, const T* axes_u, const T* axes_v,
                 const int32_t* class_ids, bool* out, Stream stream) {
  const auto kernel = disc_inside_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks_for(count), kBlockThreads, stream, voxels, count, means, axes_u, axes_v, class_ids, out);
}

void hash_bricks(int64_t count, const int32_t* ranks, const Brick* bricks, const BrickRange* classes, Brick* slots,
                 Stream stream) {
  BEAGS_LAUNCH(hash_kernel, blocks_for(count), kBlockThreads, stream, count, ranks, bricks, classes, slots);
}

#define BEAGS_INSTANTIATE(T)                                                                        \
  template void count_occupied(const Voxels&, int64_t, const T*, const int32_t*, int64_t*, Stream); \
  template void is_valid(const Voxels&, int64_t, const T*, const int32_t*, bool*, Stream);          \
  template void disc_inside(const Voxels&, int64_t, const T*, const T*, const T*, const int32_t*, bool*, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
