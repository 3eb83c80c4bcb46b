// Computes the gradients, back to front (E2 to E4, E7), with the maths of rasterizer/backward.h. Every sum has a fixed
// order: over a warp by exchanges, then over the warps of a tile, then over the tiles of a Gaussian. There are no
// atomic additions of floats, so every run gives the same bits.
#include "cuda/rasterizer/hits.h"

namespace beags {
namespace cuda {
namespace {

// Sums 16 numbers over a warp in 16 exchanges: lane 2 c gets the sum of number c, as does lane 2 c + 1.
template <class T>
BEAGS_DEVICE T warp_sum_16(T* numbers, int lane) {
#pragma unroll
  for (int half = 8; half > 0; half /= 2) {
    const bool upper = lane & (2 * half);
#pragma unroll
    for (int i = 0; i < half; ++i) {
      const T away = upper ? numbers[i] : numbers[i + half], mine = upper ? numbers[i + half] : numbers[i];
      numbers[i] = mine + __shfl_xor_sync(kWholeWarp, away, 2 * half);
    }
  }
  return numbers[0] + __shfl_xor_sync(kWholeWarp, numbers[0], 1);
}

// Sums 4 numbers: lanes 8 c .. 8 c + 7 get the sum of number c. Unrolled by hand, because a loop would put the numbers
// into memory.
template <class T>
BEAGS_DEVICE T warp_sum_4(T n0, T n1, T n2, T n3, int lane) {
  const bool second = lane & 16, odd = lane & 8;
  const T a = (second ? n2 : n0) + __shfl_xor_sync(kWholeWarp, second ? n0 : n2, 16);
  const T b = (second ? n3 : n1) + __shfl_xor_sync(kWholeWarp, second ? n1 : n3, 16);
  T sum = (odd ? b : a) + __shfl_xor_sync(kWholeWarp, odd ? a : b, 8);
  for (int step = 4; step > 0; step /= 2) sum += __shfl_xor_sync(kWholeWarp, sum, step);
  return sum;
}

// A render with more pairs than memory has no gradients; the host draws it again before it asks for any.
template <class T>
BEAGS_DEVICE bool fits(const Bins<T>& bins) {
  return bins.totals[0] <= bins.capacity;
}

// The backward's state of a pixel; g_ marks gradients of the loss.
template <class T>
struct PixelGradients {
  T transmittance, behind;  // behind: T times the part of dL/dT from hits behind
  int end, median_pair;
  T g_color[3], g_alpha, g_normal[3], g_depth, g_median_depth;  // g_depth: gradient of sum w d
  T first, g_alpha_m, g_moment;                                 // distortion: its gradient times A and sum w m
  T g_boundary;
  int32_t label;
  T g_background[3];
};

template <Parts kWanted, class T>
BEAGS_DEVICE PixelGradients<T> load_pixel(const TileJob<T>& job, const Place<T>& place) {
  PixelGradients<T> p{};
  p.median_pair = -1;
  p.label = kIgnore;
  if (!place.inside) return p;
  const int64_t at = place.at;
  const Images<const T>& g = job.gradients;
  const T end = job.kept.end_transmittance[at], alpha = T(1) - end;
  p.transmittance = end;
  p.end = job.kept.end[at];
  for (int c = 0; c < 3; ++c) {
    p.g_color[c] = g.color ? g.color[3 * at + c] : T(0);
    p.g_background[c] = p.g_color[c] * end;
    p.behind = fused(p.g_background[c], job.background[c], p.behind);
  }
  p.g_alpha = g.alpha ? g.alpha[at] : T(0);
  if ((kWanted & kGeometry) && job.kept.depth_sum) {
    for (int c = 0; c < 3; ++c) p.g_normal[c] = g.normal ? g.normal[3 * at + c] : T(0);
    p.g_median_depth = g.median_depth ? g.median_depth[at] : T(0);
    p.median_pair = job.kept.median_pair[at];
    if (g.depth && alpha > T(0)) {
      p.g_depth = g.depth[at] / alpha;
      p.g_alpha -= p.g_depth * job.kept.depth_sum[at] / alpha;
    }
  }
  if ((kWanted & kDistortion) && g.distortion) {
    const T slope = g.distortion[at];
    p.first = job.kept.first[at];
    p.g_alpha_m = slope * alpha;
    p.g_moment = slope * job.kept.moment1[at];
    p.g_alpha = fused(slope, job.kept.moment2[at], p.g_alpha);
  }
  if ((kWanted & kBoundary) && g.boundary) {
    p.label = job.target[at];
    p.g_boundary = p.label == kIgnore ? T(0) : g.boundary[at];
  }
  return p;
}

// Computes one Gaussian's part at one pixel, back to front: fills `sums`, the first 16 numbers of Record, and
// `normals`, the others.
static_assert(kNormal == 16 && kRecordEnd <= kRecord, "one array each: larger ones would lie in memory");
template <Parts kWanted, class T>
BEAGS_DEVICE void pixel_gradients(T mapping, int k, const Splat<T>& s, const Hit<T>& hit, T dx, T dy,
                                  PixelGradients<T>& p, T* sums, T* normals) {
  constexpr bool kDepths = kWanted & (kGeometry | kDistortion);
  const T inverse_left = T(1) / (T(1) - hit.alpha);
  const T before = p.transmittance * inverse_left, w = hit.alpha * before;
  // dL/dw without the part from hits behind, and the gradient of the hit's depth
  T g_w = p.g_alpha, g_hit = 0;
  for (int c = 0; c < 3; ++c) {
    g_w = fused(p.g_color[c], s.color[c], g_w);
    sums[kColor + c] = w * p.g_color[c];
  }
  if (kWanted & kGeometry) {
    for (int c = 0; c < 3; ++c) {
      g_w = fused(p.g_normal[c], s.normal[c], g_w);
      normals[c] = w * p.g_normal[c];
    }
    g_w = fused(p.g_depth, hit.depth, g_w);
    g_hit = fused(w, p.g_depth, p.median_pair == k ? p.g_median_depth : T(0));
  }
  if (kWanted & kDistortion) add_distortion(mapping, p.first, hit.nearness, p.g_alpha_m, p.g_moment, w, g_w, g_hit);
  if ((kWanted & kBoundary) && s.class_id != p.label) g_w += p.g_boundary;
  p.transmittance = before;
  const T g_log = log_alpha_slope(w, g_w, p.behind, hit.alpha, inverse_left);
  p.behind = fused(w, g_w, p.behind);
  sums[kLogOpacity] = g_log;
  const auto plane = plane_slopes<kDepths>(g_log, g_hit, hit.inverse, hit.rho, hit.depth);
  const T s_x = plane.s_0 * dx, s_y = plane.s_0 * dy;
  sums[kSx] = s_x;
  sums[kSy] = s_y;
  sums[kSxx] = s_x * dx;
  sums[kSxy] = s_x * dy;
  sums[kSyy] = s_y * dy;
  sums[kH] = plane.h;
  sums[kHx] = plane.h * dx;
  sums[kHy] = plane.h * dy;
  if (kDepths) sums[kDet] = g_hit * hit.inverse;
  if (s.plain || hit.inverse != T(0)) return;
  // Low-pass: d rho2d / dc = -4 (dx, dy); depth = p_z.
  sums[kCx] = (g_log + g_log) * dx;
  sums[kCy] = (g_log + g_log) * dy;
  if (kDepths) sums[kZ] = g_hit;
}

template <Parts kWanted, class T>
__global__ void __launch_bounds__(kTilePixels) backward_kernel(TileJob<T> job) {
  constexpr int kSize = record_size(kWanted);
  __shared__ Batch<T> batch;
  __shared__ T sums[kBatch][kTileWarps][kSize];
  __shared__ int last;
  const Place<T> place(job);
  const int thread = threadIdx.x;
  const int64_t start = job.bins.tile_start[place.tile];
  const int count = static_cast<int>(job.bins.tile_start[place.tile + 1] - start);
  PixelGradients<T> p = load_pixel<kWanted>(job, place);
  if (thread == 0) last = 0;
  for (int c = 0; c < 3; ++c) {
    const T sum = warp_sum(p.g_background[c]);
    if (place.lane == 0) sums[0][place.warp][c] = sum;
  }
  __syncthreads();
  if (p.end > 0) atomicMax(&last, p.end);
  if (thread < 3) {
    T sum = 0;
    for (int warp = 0; warp < kTileWarps; ++warp) sum += sums[0][warp][thread];
    job.g_background[3 * place.tile + thread] = fits(job.bins) ? sum : T(0);
  }
  __syncthreads();
  const int block_end = last;
  for (int stop = count; stop > 0; stop -= kBatch) {
    const int first = stop < kBatch ? 0 : stop - kBatch, here = stop - first;
    if (first >= block_end) {  // The forward stopped before.
      for (int i = thread; i < here * kSize; i += kTilePixels) {
        job.records[static_cast<int64_t>(job.bins.pairs[start + first + i / kSize]) * kSize + i % kSize] = T(0);
      }
      continue;
    }
    load_batch(job.bins, start + first, here, batch);
    __syncthreads();
    for (int j = here - 1; j >= 0; --j) {
      const int k = first + j;
      const unsigned mask = batch.masks[j];
      T own[16] = {}, normals[3] = {};
      bool on = false;
      if (mask >> (2 * place.warp) & 3) {
        const Splat<T>& splat = batch.splats[j];
        const T dx = place.x - splat.cx, dy = place.y - splat.cy;
        const bool wanted = k < p.end && (mask >> place.group & 1);
        const Hit<T> hit = evaluate(job.near_plane, splat, dx, dy, wanted);
        on = hit.on;
        if (on) pixel_gradients<kWanted>(job.mapping, k, splat, hit, dx, dy, p, own, normals);
      }
      T* to = sums[j][place.warp];
      if (__any_sync(kWholeWarp, on)) {
        const T sum = warp_sum_16(own, place.lane);
        if (place.lane % 2 == 0) to[place.lane / 2] = sum;
        if constexpr (kSize > 16) {
          const T more = warp_sum_4(normals[0], normals[1], normals[2], T(0), place.lane);
          if (place.lane % 8 == 0) to[16 + place.lane / 8] = more;
        }
      } else if (place.lane < kSize) {
        to[place.lane] = T(0);
      }
    }
    __syncthreads();
    for (int i = thread; i < here * kSize; i += kTilePixels) {
      const int j = i / kSize, number = i % kSize;
      T sum = 0;
      for (int warp = 0; warp < kTileWarps; ++warp) sum += sums[j][warp][number];
      job.records[static_cast<int64_t>(job.bins.pairs[start + first + j]) * kSize + number] = sum;
    }
    // No barrier is needed: the next batch may be loaded meanwhile, and its sums are written after the next barrier.
  }
}

// Adds up the records of one Gaussian with one warp, in the order of its tiles.
template <int kSize, class T>
__global__ void sum_records_kernel(int64_t count, Bins<T> bins, const T* records, double* sums) {
  constexpr int kTogether = kWarpThreads / kSize;  // records
  const int64_t r = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kWarpThreads;
  if (r >= count) return;
  const int lane = threadIdx.x % kWarpThreads, number = lane % kSize, which = lane / kSize;
  // Pairs beyond the memory have no records.
  const int64_t stop = bins.pair_start[r + 1] < bins.capacity ? bins.pair_start[r + 1] : bins.capacity;
  double sum = 0;
  if (which < kTogether) {
    for (int64_t pair = bins.pair_start[r] + which; pair < stop; pair += kTogether) {
      sum += records[pair * kSize + number];
    }
  }
  if (kTogether == 2) sum += __shfl_xor_sync(kWholeWarp, sum, 16);
  if (lane < kSize) sums[static_cast<int64_t>(bins.order[r]) * kRecord + lane] = sum;
}

template <class T>
BEAGS_DEVICE void write(T* values, int64_t gaussian, const double* numbers, int count) {
  for (int i = 0; values && i < count; ++i) values[count * gaussian + i] = static_cast<T>(numbers[i]);
}

template <class T>
__global__ void gaussian_gradients_kernel(View view, Inputs<T> inputs, Bins<T> bins, int size,
                                          GaussianGradients<T> to) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= inputs.count) return;
  double sums[kRecord] = {};
  ShapeGradients g{};
  double g_opacity_logit = 0;
  if (bins.counts[i] && fits(bins)) {
#pragma unroll
    for (int number = 0; number < kRecord; ++number) sums[number] = number < size ? to.sums[i * kRecord + number] : 0;
    const GaussianParameters gaussian = parameters(inputs, i);
    g_opacity_logit = sums[kLogOpacity] * gaussian.transparency;  // d log sigmoid = 1 - sigmoid
    if (to.means || to.quats || to.log_scales || to.screen_shift) g = project_backward(view, gaussian, sums);
  }
  write(to.colors, i, sums + kColor, 3);
  write(to.opacity_logits, i, &g_opacity_logit, 1);
  write(to.means, i, g.mean, 3);
  write(to.quats, i, g.quat, 4);
  write(to.log_scales, i, g.log_scale, 2);
  write(to.screen_shift, i, g.screen_shift, 2);
}

}  // namespace

template <class T>
void draw_backward(const TileJob<T>& job, Parts parts, Stream stream) {
  const int tiles = job.tiles_x * job.tiles_y;
  constexpr bool kOne = sizeof(T) == sizeof(double);
  auto kernel = backward_kernel<kAllParts, T>;
  if (!kOne && parts == 0) kernel = backward_kernel < kOne ? kAllParts : 0, T > ;
  if (!kOne && parts == kBoundary) kernel = backward_kernel < kOne ? kAllParts : kBoundary, T > ;
  if (!kOne && parts == kGeometry) kernel = backward_kernel < kOne ? kAllParts : kGeometry, T > ;
  if (!kOne && parts == (kGeometry | kBoundary))
    kernel = backward_kernel < kOne ? kAllParts : kGeometry | kBoundary, T > ;
  BEAGS_LAUNCH(kernel, tiles, kTilePixels, stream, job);
}

template <class T>
int backward_record(Parts parts) {
  if (sizeof(T) == sizeof(double)) return kRecord;
  return record_size(parts);
}

template <class T>
void reduce_records(const View& view, const Inputs<T>& inputs, const Bins<T>& bins, const T* records, int size,
                    const GaussianGradients<T>& to, Stream stream) {
  const int64_t n = inputs.count;
  auto sum = sum_records_kernel<kRecord, T>;
  if (size == kShapeRecord) sum = sum_records_kernel<kShapeRecord, T>;
  BEAGS_LAUNCH(sum, blocks_for(n * kWarpThreads), kBlockThreads, stream, n, bins, records, to.sums);
  const auto finish = gaussian_gradients_kernel<T>;
  BEAGS_LAUNCH(finish, blocks_for(n, 128), 128, stream, view, inputs, bins, size, to);
}

#define BEAGS_INSTANTIATE(T)                                                                 \
  template void draw_backward(const TileJob<T>&, Parts, Stream);                             \
  template int backward_record<T>(Parts);                                                    \
  template void reduce_records(const View&, const Inputs<T>&, const Bins<T>&, const T*, int, \
                               const GaussianGradients<T>&, Stream);
BEAGS_INSTANTIATE(float)
BEAGS_INSTANTIATE(double)
#undef BEAGS_INSTANTIATE

}  // namespace cuda
}  // namespace beags
