// Computes the images (E4, E7), with the maths of rasterizer/forward.h.
#include "cuda/rasterizer/hits.h"

namespace beags {
namespace cuda {
namespace {

template <Parts kWanted, class T>
__global__ void __launch_bounds__(kTilePixels) forward_kernel(TileJob<T> job) {
  constexpr bool kDraw = kWanted & kGeometry, kSpread = kWanted & kDistortion, kBorder = kWanted & kBoundary;
  const Place<T> place(job);
  Walk<T> walk;
  T color[3] = {}, normal[3] = {}, depth = 0, median_depth = 0;
  T first = 0, moment1 = 0, moment2 = 0, boundary = 0;
  int median_pair = -1;
  const int32_t label = kBorder && job.target && place.inside ? job.target[place.at] : kIgnore;
  composite(job, place, walk, [&](int k, const Splat<T>& s, const Hit<T>& hit, T w, T before) {
    if (!(w > T(0))) return;
    for (int c = 0; c < 3; ++c) color[c] = fused(w, s.color[c], color[c]);
    if (kDraw) {
      for (int c = 0; c < 3; ++c) normal[c] = fused(w, s.normal[c], normal[c]);
      depth = fused(w, hit.depth, depth);
      if (before > T(0.5)) {  // the last such hit: where T ends below that, it is the one at which T passes 0.5
        median_depth = hit.depth;
        median_pair = k;
      }
    }
    if (kSpread) {
      if (first == T(0)) first = hit.nearness;
      const T m = first - hit.nearness, wm = w * m;  // m_i - m_first: only differences count
      moment1 += wm;
      moment2 = fused(wm, m, moment2);
    }
    if (kBorder && s.class_id != label) boundary += w;  // E7
  });
  if (!place.inside) return;
  const T end = walk.transmittance, alpha = T(1) - end;  // E4: A = sum w = 1 - T
  if (end > T(0.5)) {
    median_depth = 0;
    median_pair = -1;
  }
  const int64_t at = place.at;
  if (job.kept.end) {
    job.kept.end_transmittance[at] = end;
    job.kept.end[at] = walk.end;
    if (kDraw && job.kept.depth_sum) {
      job.kept.depth_sum[at] = depth;
      job.kept.median_pair[at] = median_pair;
    }
    if (kSpread && job.kept.first) {
      job.kept.first[at] = first;
      job.kept.moment1[at] = moment1;
      job.kept.moment2[at] = moment2;
    }
  }
  job.images.alpha[at] = alpha;
  for (int c = 0; c < 3; ++c) job.images.color[3 * at + c] = color[c] + end * job.background[c];
  if (kDraw && job.images.depth) {
    job.images.depth[at] = alpha > T(0) ? depth / alpha : T(0);
    job.images.median_depth[at] = median_depth;
    for (int c = 0; c < 3; ++c) job.images.normal[3 * at + c] = normal[c];
  }
  if (kSpread && job.images.distortion) {
    // The sum over pairs in closed form, A sum(w m^2) - (sum w m)^2; rounding must not make it negative.
    const T value = alpha * moment2 - moment1 * moment1;
    job.images.distortion[at] = value > T(0) ? value : T(0);
  }
  if (kBorder && job.images.boundary) job.images.boundary[at] = label == kIgnore ? T(0) : boundary;
}

}  // namespace

template <class T>
void draw_forward(const TileJob<T>& job, Stream stream) {
  const int tiles = job.tiles_x * job.tiles_y;
  const Parts parts = (job.images.depth ? kGeometry : 0) | (job.images.distortion ? kDistortion : 0) |
                      (job.images.boundary ? kBoundary : 0);
  // float64, which checks float32, has one variant.
  constexpr bool kOne = sizeof(T) == sizeof(double);
  auto kernel = forward_kernel<kAllParts, T>;
  if (!kOne && parts == 0) kernel = forward_kernel < kOne ? kAllParts : 0, T > ;
  if (!kOne && parts == kGeometry) kernel = forward_kernel < kOne ? kAllParts : kGeometry, T > ;
  if (!kOne && parts == (kGeometry | kBoundary))
    kernel = forward_kernel < kOne ? kAllParts : kGeometry | kBoundary, T > ;
  BEAGS_LAUNCH(kernel, tiles, kTilePixels, stream, job);
}

template void draw_forward(const TileJob<float>&, Stream);
template void draw_forward(const TileJob<double>&, Stream);

}  // namespace cuda
}  // namespace beags
