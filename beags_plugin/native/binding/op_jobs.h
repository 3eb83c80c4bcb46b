// Makes the ops' jobs from Python's arrays, for CPUs and GPUs alike.
#pragma once

#include <algorithm>
#include <cstdint>
#include <optional>
#include <vector>

#include "binding/arrays.h"
#include "ops/kernels.h"
#include "ops/lifted_view.h"
#include "ops/reprojection_votes.h"

namespace beags {
namespace ops {

// Makes the job without the voxels' table. origin: three coordinates.
template <class T, Memory kMemory, class Origin>
OccupancyJob<T> occupancy_job(const Array<const T, kMemory>& means, const Array<const T, kMemory>& quats,
                              const Array<const T, kMemory>& log_scales, const Array<const T, kMemory>& opacity_logits,
                              const Array<const int32_t, kMemory>& class_ids, const Origin& origin, double voxel_size,
                              uint64_t stream, int64_t samples, bool background, const Array<T, kMemory>& g_means,
                              const Array<T, kMemory>& g_quats, const Array<T, kMemory>& g_log_scales,
                              const Array<T, kMemory>& g_opacity_logits, double weight, bool skip) {
  const double draws = static_cast<double>(class_ids.shape(0)) * static_cast<double>(samples);
  OccupancyJob<T> job{};
  job.means = means.data();
  job.quats = quats.data();
  job.log_scales = log_scales.data();
  job.opacity_logits = opacity_logits.data();
  job.class_ids = class_ids.data();
  for (int axis = 0; axis < 3; ++axis) job.origin[axis] = static_cast<T>(origin[axis]);
  job.voxel_size = static_cast<T>(voxel_size);
  job.stream = stream;
  job.skip = skip;
  job.samples = samples;
  job.background = background;
  job.factor = weight / (draws > 0.0 ? draws : 1.0);
  job.g_means = g_means.data();
  job.g_quats = g_quats.data();
  job.g_log_scales = g_log_scales.data();
  job.g_opacity_logits = g_opacity_logits.data();
  return job;
}

// Makes the job without the memory for slopes and sums.
template <class T, Memory kMemory>
PhotometricJob<T> photometric_job(const Array<const T, kMemory>& image, const Array<const T, kMemory>& reference,
                                  double c1, double c2, double l1_scale, double ssim_scale,
                                  const Array<T, kMemory>& gradient) {
  PhotometricJob<T> job{};
  job.height = static_cast<int>(image.shape(0));
  job.width = static_cast<int>(image.shape(1));
  job.image = image.data();
  job.reference = reference.data();
  set_window(job);
  job.c1 = static_cast<T>(c1);
  job.c2 = static_cast<T>(c2);
  job.l1_scale = static_cast<T>(l1_scale);
  job.ssim_scale = static_cast<T>(ssim_scale);
  job.gradient = gradient.data();
  return job;
}

// Makes the job without the memory for shares and sums.
template <class T, Memory kMemory>
NormalJob<T> normal_job(const Array<const T, kMemory>& depth, const Array<const T, kMemory>& normal,
                        const Array<const T, kMemory>& alpha, double fx, double fy, double skew, double cx, double cy,
                        double scale, const Array<T, kMemory>& g_depth, const Array<T, kMemory>& g_normal) {
  NormalJob<T> job{};
  job.height = static_cast<int>(depth.shape(0));
  job.width = static_cast<int>(depth.shape(1));
  job.fx_inverse = static_cast<T>(1 / fx);
  job.fy_inverse = static_cast<T>(1 / fy);
  job.skew = static_cast<T>(skew);
  job.cx = static_cast<T>(cx);
  job.cy = static_cast<T>(cy);
  job.depth = depth.data();
  job.normal = normal.data();
  job.alpha = alpha.data();
  job.scale = static_cast<T>(scale);
  job.g_depth = g_depth.data();
  job.g_normal = g_normal.data();
  return job;
}

// Makes the part of the job that forward and backward share. center: three coordinates.
template <class T, Memory kMemory, class Center>
ColorJob<T> color_job(const Array<const T, kMemory>& sh_dc, const Array<const T, kMemory>& sh_rest,
                      const Array<const T, kMemory>& means, const Center& center, int degree,
                      const Array<uint8_t, kMemory>& clamped) {
  ColorJob<T> job{};
  job.degree = degree;
  job.num_rest = static_cast<int>(sh_rest.shape(1));
  for (int axis = 0; axis < 3; ++axis) job.center[axis] = static_cast<T>(center[axis]);
  job.dc = sh_dc.data();
  job.rest = sh_rest.data();
  job.means = means.data();
  job.clamped = clamped.data();
  return job;
}

// Adds the backward's gradients to a job of `color_job`.
template <class T, Memory kMemory>
void add_gradients(ColorJob<T>& job, const Array<const T, kMemory>& g_colors, const Array<T, kMemory>& g_dc,
                   const Array<T, kMemory>& g_rest, const Array<T, kMemory>& g_means) {
  job.g_colors = g_colors.data();
  job.g_dc = g_dc.data();
  job.g_rest = g_rest.data();
  job.g_means = g_means.data();
}

// Makes the view from its depth. to_voxels: [13], a row by row, b, the side of a voxel.
template <class T, Memory kMemory>
LiftedView<T> lifted_view(const Array<const T, kMemory>& depth, const Array<const T>& to_voxels) {
  const int height = static_cast<int>(depth.shape(0)), width = static_cast<int>(depth.shape(1));
  LiftedView<T> view{height, width, depth.data(), {}, {}, to_voxels.data()[12]};
  std::copy_n(to_voxels.data(), 9, view.a);
  std::copy_n(to_voxels.data() + 9, 3, view.b);
  return view;
}

// Makes the views of the pairwise votes. A view without labels of either type does not vote.
template <class T, Memory kMemory>
std::vector<VotingView<T>> voting_views(const std::vector<Array<const T, kMemory>>& depths,
                                        const std::vector<std::optional<Array<const int32_t, kMemory>>>& labels,
                                        const std::vector<std::optional<Array<const uint8_t, kMemory>>>& short_labels) {
  std::vector<VotingView<T>> views;
  for (size_t v = 0; v < depths.size(); ++v) {
    views.push_back({static_cast<int>(depths[v].shape(0)), static_cast<int>(depths[v].shape(1)), depths[v].data(),
                     labels[v] ? labels[v]->data() : nullptr, short_labels[v] ? short_labels[v]->data() : nullptr});
  }
  return views;
}

// Makes the targets: views first, first + 1, .. maps: [targets, views, 12].
template <class T, Memory kMemory>
std::vector<VotedView<T>> voted_views(int first, const Array<const T>& maps, size_t views,
                                      const std::vector<Array<int32_t, kMemory>>& voted,
                                      const std::vector<Array<float, kMemory>>& confidence) {
  std::vector<VotedView<T>> targets;
  for (size_t t = 0; t < voted.size(); ++t) {
    targets.push_back(
        {first + static_cast<int>(t), maps.data() + 12 * views * t, voted[t].data(), confidence[t].data()});
  }
  return targets;
}

}  // namespace ops
}  // namespace beags
