// Computes the occupancy loss (method, section 6; E9) on a GPU: values and closed-form gradients in one pass, whose
// memory does not depend on the number of samples. A block skips the Gaussians whose disc lies wholly in valid voxels
// and gives the others to its first threads, so that warps are full. The maths is that of ops/occupancy_loss_kernel.h.
#include "cuda/ops/block_sums.h"
#include "cuda/ops/ops.h"
#include "ops/occupancy_loss_terms.h"
#include "rasterizer/quaternion.h"

namespace beags {
namespace cuda {
namespace {

using namespace ops;
using namespace ops::BEAGS_ISA;

// Applies the SplitMix64 finaliser, as occupancy/sampling.py.
BEAGS_DEVICE uint64_t mix(uint64_t word) {
  word = (word ^ word >> 30) * 0xBF58476D1CE4E5B9u;
  word = (word ^ word >> 27) * 0x94D049BB133111EBu;
  return word ^ word >> 31;
}

// Computes cosine and sine of angle / 2^24 turns.
BEAGS_DEVICE void cos_sin(uint32_t angle, float& cosine, float& sine) {
#if defined(BEAGS_CUDA_EMULATION)
  cosine = static_cast<float>(std::cos(angle * 3.745070282923929e-07));
  sine = static_cast<float>(std::sin(angle * 3.745070282923929e-07));
#else
  sincospif(static_cast<float>(angle) * (1.0f / (1 << 23)), &sine, &cosine);
#endif
}
BEAGS_DEVICE void cos_sin(uint32_t angle, double& cosine, double& sine) {
  const double x = static_cast<double>(angle) * 3.745070282923929e-07;
  cosine = cos(x);
  sine = sin(x);
}

template <class T>
BEAGS_DEVICE bool is_finite(T x) {
  return x - x == T(0);
}

// A Gaussian's disc.
template <class T>
struct Disc : DiscFrame<T> {
  bool broken;  // It counts as 0: a number is not finite, a scale is 0 or the quaternion is unusable.

  BEAGS_DEVICE Disc(const OccupancyJob<T>& job, int64_t i) {
    DiscFrame<T>& f = *this;
    for (int axis = 0; axis < 2; ++axis) f.scale[axis] = exp(job.log_scales[2 * i + axis]);
    fill_frame(job, job.means + 3 * i, job.quats + 4 * i, f);
    broken = !is_finite(job.opacity_logits[i]) || !usable_quaternion(f.inverse_length);
    for (int axis = 0; axis < 2; ++axis) {
      broken = broken || !is_finite(job.log_scales[2 * i + axis]) || !is_finite(T(1) / f.scale[axis]);
    }
    for (int axis = 0; axis < 3; ++axis) {
      const T reach = T(3) * f.scale[0] * f.r0[axis] + T(3) * f.scale[1] * f.r1[axis];
      broken = broken || !is_finite(job.means[3 * i + axis]) || !is_finite(reach);
    }
  }

  // Sets the box of voxels that the disc reaches: `size` voxels along each axis, from `low`. Returns the largest size,
  // or a size larger than any window if the disc is too far away to be looked up.
  BEAGS_DEVICE int box(int64_t* low, int* size) const {
    constexpr int kFarOff = 1 << 20;
    int largest = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const T center = this->center[axis], distance = fabs(center);
      const T half = reach_along<T>(this->axis_u[axis], this->axis_v[axis], distance);
      low[axis] = 0;
      size[axis] = kFarOff;
      if (distance + half < static_cast<T>(kVoxelHalf)) {
        low[axis] = static_cast<int64_t>(floor(center - half));
        size[axis] = static_cast<int>(static_cast<int64_t>(floor(center + half)) - low[axis]) + 1;
      }
      largest = size[axis] > largest ? size[axis] : largest;
    }
    return largest;
  }
};

// Returns whether a disc surely lies in valid voxels.
BEAGS_DEVICE bool wholly_inside(const VoxelTable* cubes, int32_t class_id, const int64_t* low, const int* size,
                                int largest) {
  if (largest <= kLargestCube) {
    if (voxel_bit(cubes[largest - 1], class_id, low)) return true;
  }
  if (largest <= 4) {
    const uint64_t box = box_bits(size[0], size[1], size[2]);
    return (voxel_box(cubes[0], class_id, low, size) & box) == box;
  }
  if (largest > kWindowVoxels || class_id < 0 || class_id >= cubes->num_classes) return false;
  int64_t corner[3] = {low[0], low[1], low[2]};
  uint64_t window[kWindow * kWindow * kWindow];
  return fill_window(cubes[0], class_id, corner, size, window);
}

// Samples one Gaussian, writes its gradients, returns its loss.
template <class T>
BEAGS_DEVICE double sample(const OccupancyJob<T>& job, const VoxelTable& valid, int64_t i) {
  const Disc<T> disc(job, i);
  const T opacity = T(1) / (T(1) + exp(-job.opacity_logits[i]));
  const int32_t class_id = job.class_ids[i];
  const bool known = class_id >= 0 && class_id < valid.num_classes;
  int64_t low[3];
  int size[3];
  const bool near = disc.box(low, size) <= 4;
  const uint64_t bits = near && known ? voxel_box(valid, class_id, low, size) : 0;
  uint64_t word = mix(static_cast<uint64_t>(i) * kGolden + job.stream);  // hash of stream and Gaussian
  T sums[6] = {};
  for (int64_t s = 0; s < job.samples; ++s, word += kGolden) {
    const uint64_t random = mix(word);
    const T area = static_cast<T>(static_cast<uint32_t>(random >> 40)) * T(1.0 / (1 << 24));  // (r / 3)^2
    const T radius = T(3) * sqrt(area);  // The area grows with the square of the radius.
    T u, v;
    cos_sin(static_cast<uint32_t>(random << 32 >> 40), u, v);
    u *= radius;
    v *= radius;
    int64_t index[3];
    for (int axis = 0; axis < 3; ++axis) {
      const T at = fused(v, disc.axis_v[axis], fused(u, disc.axis_u[axis], disc.center[axis]));
      const T limit = static_cast<T>(kVoxelHalf + 4);
      index[axis] = static_cast<int64_t>(floor(at > limit ? limit : at < -limit ? -limit : at));
    }
    bool is_valid = false;
    if (near) {
      const int64_t x = index[0] - low[0], y = index[1] - low[1], z = index[2] - low[2];
      is_valid = bits >> ((x & 3) << 4 | (y & 3) << 2 | (z & 3)) & 1;
    } else if (known) {
      for (int axis = 0; axis < 3; ++axis) index[axis] += kVoxelShift;
      const int place = static_cast<int>((index[0] & 3) << 4 | (index[1] & 3) << 2 | (index[2] & 3));
      is_valid = brick_bits(valid, class_id, index[0] >> 2, index[1] >> 2, index[2] >> 2) >> place & 1;
    }
    if (is_valid) continue;
    add_sample(exp(T(-4.5) * area), u, v, sums);
  }
  if (job.g_means) {
    T out[10];
    disc_gradients(job, static_cast<const DiscFrame<T>&>(disc), opacity, sums, out);
    for (int axis = 0; axis < 3; ++axis) job.g_means[3 * i + axis] = out[axis];
    for (int part = 0; part < 4; ++part) job.g_quats[4 * i + part] = out[3 + part];
    for (int axis = 0; axis < 2; ++axis) job.g_log_scales[2 * i + axis] = out[7 + axis];
    job.g_opacity_logits[i] = out[9];
  }
  return static_cast<double>(opacity * sums[0]) * job.factor;
}

template <class T>
__global__ void __launch_bounds__(kOccupancyThreads)
    occupancy_kernel(OccupancyJob<T> job, Voxels voxels, int64_t count, double* partial) {
  constexpr int kWarps = kOccupancyThreads / kWarpThreads;
  __shared__ int active[kOccupancyThreads];
  __shared__ int found[kWarps];
  const int thread = threadIdx.x, warp = thread / kWarpThreads, lane = thread % kWarpThreads;
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kOccupancyThreads, i = first + thread;
  bool wanted = false;
  if (i < count) {
    if (job.g_means) {
      for (int axis = 0; axis < 3; ++axis) job.g_means[3 * i + axis] = 0;
      for (int part = 0; part < 4; ++part) job.g_quats[4 * i + part] = 0;
      for (int axis = 0; axis < 2; ++axis) job.g_log_scales[2 * i + axis] = 0;
      job.g_opacity_logits[i] = 0;
    }
    const int32_t class_id = job.class_ids[i];
    if (job.background || class_id != 0) {
      const Disc<T> disc(job, i);
      if (!disc.broken) {
        int64_t low[3];
        int size[3];
        const int largest = disc.box(low, size);
        wanted = !job.skip || !wholly_inside(voxels.valid, class_id, low, size, largest);
      }
    }
  }
  const unsigned votes = __ballot_sync(kWholeWarp, wanted);
  if (lane == 0) found[warp] = __popc(votes);
  __syncthreads();
  int place = __popc(votes & ((1u << lane) - 1)), total = 0;
  for (int w = 0; w < kWarps; ++w) {
    if (w < warp) place += found[w];
    total += found[w];
  }
  if (wanted) active[place] = thread;
  __syncthreads();
  double loss[1] = {};
  if (thread < total) loss[0] = sample(job, voxels.valid[0], first + active[thread]);
  block_sums<kOccupancyThreads>(loss);
  if (thread == 0) partial[blockIdx.x] = loss[0];
}

template <class T>
__global__ void __launch_bounds__(kSumThreads) occupancy_value_kernel(int64_t blocks, const double* partial, T* value) {
  double sums[1];
  sum_of_blocks(blocks, partial, sums);
  if (threadIdx.x == 0) *value = static_cast<T>(sums[0]);
}

}  // namespace

template <class T>
void occupancy_loss(const OccupancyJob<T>& job, const Voxels& voxels, int64_t count, double* partial, T* value,
                    Stream stream) {
  const int64_t blocks = blocks_for(count, kOccupancyThreads);
  const auto kernel = occupancy_kernel<T>;
  BEAGS_LAUNCH(kernel, blocks, kOccupancyThreads, stream, job, voxels, count, partial);
  const auto finish = occupancy_value_kernel<T>;
  BEAGS_LAUNCH(finish, 1, kSumThreads, stream, blocks, partial, value);
}

#define BEAGS_INSTANTIATE(T) \
  template void occupancy_loss(const OccupancyJob<T>&, const Voxels&, int64_t, double*, T*, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
