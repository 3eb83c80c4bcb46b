// Binds the CUDA ops. beags_plugin/ops checks all arguments, once.
#include "binding/module_cuda_ops.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>

#include "binding/arrays.h"
#include "binding/op_jobs.h"
#include "cuda/ops/ops.h"
#include "cuda/ops/voxel_votes.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

using namespace cuda;
using ops::add_gradients;
using ops::color_job;
using ops::ColorJob;
using ops::NormalJob;
using ops::occupancy_job;
using ops::OccupancyJob;
using ops::PhotometricJob;
using ops::VoxelTable;

template <class T>
using Device = Array<T, Memory::kCuda>;
using DeviceIds = Device<const int32_t>;

Stream stream_of(uintptr_t stream) { return reinterpret_cast<Stream>(stream); }

VoxelTable table(int num_classes, const std::vector<int>& base, const std::vector<int>& size, Device<uint8_t> dense,
                 Device<uint8_t> bricks, Device<uint8_t> classes) {
  VoxelTable out{};
  out.num_classes = num_classes;
  out.dense = reinterpret_cast<const uint64_t*>(dense.data());
  for (int axis = 0; axis < 3; ++axis) {
    out.base[axis] = base.at(axis);
    out.size[axis] = size.at(axis);
  }
  out.bricks = reinterpret_cast<const ops::Brick*>(bricks.data());
  out.classes = reinterpret_cast<const ops::BrickRange*>(classes.data());
  return out;
}

template <class T>
void bind(nb::module_& m, const char* suffix) {
  using In = Device<const T>;
  using Out = Device<T>;
  const std::string end(suffix);
  m.def(("count_" + end).c_str(),
        [](const Voxels& voxels, In points, DeviceIds class_ids, Device<int64_t> out, uintptr_t stream) {
          count_occupied(voxels, class_ids.shape(0), points.data(), class_ids.data(), out.data(), stream_of(stream));
        });
  m.def(("valid_" + end).c_str(),
        [](const Voxels& voxels, In points, DeviceIds class_ids, Device<bool> out, uintptr_t stream) {
          is_valid(voxels, class_ids.shape(0), points.data(), class_ids.data(), out.data(), stream_of(stream));
        });
  m.def(("disc_inside_" + end).c_str(), [](const Voxels& voxels, In means, In axes_u, In axes_v, DeviceIds class_ids,
                                           Device<bool> out, uintptr_t stream) {
    disc_inside(voxels, class_ids.shape(0), means.data(), axes_u.data(), axes_v.data(), class_ids.data(), out.data(),
                stream_of(stream));
  });
  m.def(("occupancy_loss_" + end).c_str(),
        [](In means, In quats, In log_scales, In opacity_logits, DeviceIds class_ids, const Voxels& voxels,
           uint64_t stream_of_numbers, int64_t samples, bool background, Out g_means, Out g_quats, Out g_log_scales,
           Out g_opacity_logits, Device<double> partial, Out value, double weight, bool skip, uintptr_t stream) {
          const int64_t count = class_ids.shape(0);
          const OccupancyJob<T> job = occupancy_job<T>(
              means, quats, log_scales, opacity_logits, class_ids, voxels.origin, voxels.voxel_size, stream_of_numbers,
              samples, background, g_means, g_quats, g_log_scales, g_opacity_logits, weight, skip);
          occupancy_loss(job, voxels, count, partial.data(), value.data(), stream_of(stream));
        },
        "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "class_ids"_a, "voxels"_a, "numbers"_a, "samples"_a,
        "background"_a, "g_means"_a.none(), "g_quats"_a.none(), "g_log_scales"_a.none(), "g_opacity_logits"_a.none(),
        "partial"_a, "value"_a, "weight"_a, "skip"_a, "stream"_a);
  m.def(("sh_colors_" + end).c_str(),
        [](In sh_dc, In sh_rest, In means, const std::vector<double>& center, int degree, Out colors,
           Device<uint8_t> clamped, uintptr_t stream) {
          ColorJob<T> job = color_job<T>(sh_dc, sh_rest, means, center, degree, clamped);
          job.colors = colors.data();
          sh_colors(job, means.shape(0), stream_of(stream));
        },
        "sh_dc"_a, "sh_rest"_a, "means"_a, "center"_a, "degree"_a, "colors"_a, "clamped"_a, "stream"_a);
  m.def(("sh_colors_backward_" + end).c_str(),
        [](In sh_dc, In sh_rest, In means, const std::vector<double>& center, int degree, Device<uint8_t> clamped,
           In g_colors, Out g_dc, Out g_rest, Out g_means, uintptr_t stream) {
          ColorJob<T> job = color_job<T>(sh_dc, sh_rest, means, center, degree, clamped);
          add_gradients(job, g_colors, g_dc, g_rest, g_means);
          sh_colors_backward(job, means.shape(0), stream_of(stream));
        },
        "sh_dc"_a, "sh_rest"_a, "means"_a, "center"_a, "degree"_a, "clamped"_a, "g_colors"_a, "g_dc"_a.none(),
        "g_rest"_a.none(), "g_means"_a.none(), "stream"_a);
}

template <class T>
void bind_images(nb::module_& m, const char* suffix) {
  using In = Device<const T>;
  using Out = Device<T>;
  const std::string end(suffix);
  m.def(("photometric_" + end).c_str(),
        [](In image, In reference, double c1, double c2, double l1_scale, double ssim_scale, double offset, Out slopes,
           Out gradient, Device<double> sums, Out value, uintptr_t stream) {
          PhotometricJob<T> job = ops::photometric_job<T>(image, reference, c1, c2, l1_scale, ssim_scale, gradient);
          job.slopes = slopes.data();
          job.sums = sums.data();
          photometric(job, offset, value.data(), stream_of(stream));
        },
        "image"_a, "reference"_a, "c1"_a, "c2"_a, "l1_scale"_a, "ssim_scale"_a, "offset"_a, "slopes"_a.none(),
        "gradient"_a.none(), "sums"_a, "value"_a, "stream"_a);
  m.def(("normal_consistency_" + end).c_str(),
        [](In depth, In normal, In alpha, double fx, double fy, double skew, double cx, double cy, double scale,
           Out g_depth, Out g_normal, Out shares, Device<double> sums, Out value, uintptr_t stream) {
          NormalJob<T> job = ops::normal_job<T>(depth, normal, alpha, fx, fy, skew, cx, cy, scale, g_depth, g_normal);
          job.shares = shares.data();
          job.sums = sums.data();
          normal_consistency(job, value.data(), stream_of(stream));
        },
        "depth"_a, "normal"_a, "alpha"_a, "fx"_a, "fy"_a, "skew"_a, "cx"_a, "cy"_a, "scale"_a, "g_depth"_a.none(),
        "g_normal"_a.none(), "shares"_a.none(), "sums"_a, "value"_a, "stream"_a);
}

template <class T>
void bind_votes(nb::module_& m, const char* suffix) {
  using In = Device<const T>;
  const std::string end(suffix);
  m.def(("reprojection_votes_" + end).c_str(),
        [](const std::vector<In>& depths, const std::vector<std::optional<DeviceIds>>& labels,
           const std::vector<std::optional<Device<const uint8_t>>>& short_labels, int first, Array<const T> maps,
           const std::vector<Device<int32_t>>& voted, const std::vector<Device<float>>& confidence, int num_classes,
           double tau, Device<int32_t> counters, uintptr_t stream) {
          const auto views = ops::voting_views(depths, labels, short_labels);
          const auto targets = ops::voted_views(first, maps, views.size(), voted, confidence);
          reprojection_votes(views, targets, num_classes, tau, reinterpret_cast<uint32_t*>(counters.data()),
                             stream_of(stream));
        },
        "depths"_a, "labels"_a, "short_labels"_a, "first"_a, "maps"_a, "voted"_a, "confidence"_a, "num_classes"_a,
        "tau"_a, "counters"_a, "stream"_a);
  m.def(("vote_pixels_" + end).c_str(), [](const VoxelTally& tally, In depth, Array<const T> to_voxels,
                                           DeviceIds labels, int32_t ignore, uintptr_t stream) {
    vote_pixels(tally, ops::lifted_view(depth, to_voxels), labels.data(), ignore, stream_of(stream));
  });
  m.def(("vote_points_" + end).c_str(), [](const VoxelTally& tally, In points, DeviceIds class_ids,
                                           const std::vector<double>& origin, double size, uintptr_t stream) {
    VoxelFrame<T> frame{{}, static_cast<T>(size)};
    for (int axis = 0; axis < 3; ++axis) frame.origin[axis] = static_cast<T>(origin.at(axis));
    vote_points(tally, points.data(), class_ids.data(), class_ids.shape(0), frame, stream_of(stream));
  });
  m.def(("read_votes_" + end).c_str(), [](const VoxelTally& tally, In depth, Array<const T> to_voxels,
                                          Device<int32_t> labels, Device<float> confidence, uintptr_t stream) {
    read_votes(tally, ops::lifted_view(depth, to_voxels), labels.data(), confidence.data(), stream_of(stream));
  });
}

void bind_tally(nb::module_& m) {
  using Longs = Device<int64_t>;
  using Ints = Device<int32_t>;
  const auto counts = [](const Ints& ints) { return reinterpret_cast<uint32_t*>(ints.data()); };
  const auto keys_of = [](const Longs& longs) { return reinterpret_cast<uint64_t*>(longs.data()); };
  nb::class_<VoxelTally>(m, "VoxelTally")
      .def(
          "__init__",
          [=](VoxelTally* self, Longs keys, Ints labels, Ints votes, Ints further, Longs more_keys, Ints more_votes,
              Ints more_next, Ints used, Ints leaders, Ints totals) {
            new (self) VoxelTally{keys.shape(0),    more_keys.shape(0), keys_of(keys),      labels.data(),
                                  counts(votes),    further.data(),     keys_of(more_keys), counts(more_votes),
                                  more_next.data(), used.data(),        leaders.data(),     counts(totals)};
          },
          "keys"_a, "labels"_a, "votes"_a, "further"_a, "more_keys"_a, "more_votes"_a, "more_next"_a, "used"_a,
          "leaders"_a.none(), "totals"_a.none());
  m.def("move_votes", [](const VoxelTally& from, const VoxelTally& to, uintptr_t stream) {
    move_votes(from, to, stream_of(stream));
  });
  m.def("decide_votes", [](const VoxelTally& tally, uintptr_t stream) { decide(tally, stream_of(stream)); });
  m.def("hash_bricks", [](Ints ranks, Longs bricks, Longs classes, Longs slots, uintptr_t stream) {
    hash_bricks(ranks.shape(0), ranks.data(), reinterpret_cast<const ops::Brick*>(bricks.data()),
                reinterpret_cast<const ops::BrickRange*>(classes.data()), reinterpret_cast<ops::Brick*>(slots.data()),
                stream_of(stream));
  });
}

}  // namespace

void bind_cuda_ops(nb::module_& m) {
  nb::class_<VoxelTable>(m, "VoxelTable")
      .def(
          "__init__",
          [](VoxelTable* self, int num_classes, const std::vector<int>& base, const std::vector<int>& size,
             Device<uint8_t> dense, Device<uint8_t> bricks, Device<uint8_t> classes) {
            new (self) VoxelTable(table(num_classes, base, size, dense, bricks, classes));
          },
          "num_classes"_a, "base"_a, "size"_a, "dense"_a.none(), "bricks"_a.none(), "classes"_a.none());
  nb::class_<Voxels>(m, "Voxels")
      .def(
          "__init__",
          [](Voxels* self, const std::vector<VoxelTable>& tables, const std::vector<double>& origin,
             double voxel_size) {
            new (self) Voxels{tables.at(0),
                              {tables.at(1), tables.at(2), tables.at(3)},
                              {origin.at(0), origin.at(1), origin.at(2)},
                              voxel_size};
          },
          "tables"_a, "origin"_a, "voxel_size"_a);
  m.attr("OCCUPANCY_THREADS") = kOccupancyThreads;
  m.attr("PHOTOMETRIC_TILE") = kPhotometricTile;
  m.attr("NORMAL_THREADS") = kNormalThreads;
  bind<float>(m, "f32");
  bind<double>(m, "f64");
  bind_images<float>(m, "f32");
  bind_images<double>(m, "f64");
  bind_votes<float>(m, "f32");
  bind_votes<double>(m, "f64");
  bind_tally(m);
}

}  // namespace beags
