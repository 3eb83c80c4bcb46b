// Binds the ops: plain arrays in and out. beags_plugin/ops checks all arguments, once.
#include "binding/module_ops.h"

#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>

#include "binding/arrays.h"
#include "binding/op_jobs.h"
#include "ops/occupancy_loss.h"
#include "ops/reprojection_votes.h"
#include "ops/sh_colors.h"
#include "ops/sparse_sums.h"
#include "ops/voxel_lookup.h"
#include "ops/voxel_votes.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

using namespace ops;

int64_t rows(const Ids& ids) { return static_cast<int64_t>(ids.shape(0)); }

template <class T>
void bind_sums(nb::class_<SparseSums>& sums, const char* suffix) {
  sums.def((std::string("add_") + suffix).c_str(),
           [](SparseSums& self, Array<const int64_t> keys, Array<const T> values) {
             nb::gil_scoped_release release;
             self.add(keys.data(), values.data(), keys.shape(0));
           },
           "keys"_a, "values"_a);
}

template <class T>
void bind_lookup(nb::class_<VoxelLookup>& lookup, const char* suffix) {
  using In = Array<const T>;
  const std::string end(suffix);
  lookup.def(("count_" + end).c_str(),
             [](const VoxelLookup& self, In points, Ids class_ids, Array<int64_t> out, int threads) {
               nb::gil_scoped_release release;
               self.count_occupied(rows(class_ids), points.data(), class_ids.data(), out.data(), threads);
             },
             "points"_a, "class_ids"_a, "out"_a, "threads"_a);
  lookup.def(("valid_" + end).c_str(),
             [](const VoxelLookup& self, In points, Ids class_ids, Array<bool> out, int threads) {
               nb::gil_scoped_release release;
               self.is_valid(rows(class_ids), points.data(), class_ids.data(), out.data(), threads);
             },
             "points"_a, "class_ids"_a, "out"_a, "threads"_a);
  lookup.def(("disc_inside_" + end).c_str(),
             [](const VoxelLookup& self, In means, In axes_u, In axes_v, Ids class_ids, Array<bool> out, int threads) {
               nb::gil_scoped_release release;
               self.disc_inside(rows(class_ids), means.data(), axes_u.data(), axes_v.data(), class_ids.data(),
                                out.data(), threads);
             },
             "means"_a, "axes_u"_a, "axes_v"_a, "class_ids"_a, "out"_a, "threads"_a);
}

template <class T>
void bind_votes(nb::class_<VoxelVotes>& votes, const char* suffix) {
  using In = Array<const T>;
  const std::string end(suffix);
  votes.def(("add_" + end).c_str(),
            [](VoxelVotes& self, In depth, In to_voxels, Ids labels, int32_t ignore) {
              nb::gil_scoped_release release;
              self.add(lifted_view(depth, to_voxels), labels.data(), ignore);
            },
            "depth"_a, "to_voxels"_a, "labels"_a, "ignore"_a);
  votes.def(("read_" + end).c_str(),
            [](const VoxelVotes& self, In depth, In to_voxels, Array<int32_t> labels, Array<float> confidence) {
              nb::gil_scoped_release release;
              self.read(lifted_view(depth, to_voxels), labels.data(), confidence.data());
            },
            "depth"_a, "to_voxels"_a, "labels"_a, "confidence"_a);
}

template <class T>
void bind_functions(nb::module_& m, const char* suffix) {
  using In = Array<const T>;
  using Out = Array<T>;
  const std::string end(suffix);
  m.def(("occupancy_loss_" + end).c_str(),
        [](In means, In quats, In log_scales, In opacity_logits, Ids class_ids, const VoxelLookup& lookup,
           uint64_t stream, int64_t samples, bool background, Out g_means, Out g_quats, Out g_log_scales,
           Out g_opacity_logits, int threads, double weight, bool skip) {
          const auto cubes = lookup.valid_cubes();
          const int64_t count = rows(class_ids);
          OccupancyJob<T> job = occupancy_job<T>(means, quats, log_scales, opacity_logits, class_ids, lookup.origin(),
                                                 lookup.voxel_size(), stream, samples, background, g_means, g_quats,
                                                 g_log_scales, g_opacity_logits, weight, skip);
          job.valid = cubes.data();
          OccupancyResult result;
          {
            nb::gil_scoped_release release;
            result = occupancy_loss(job, count, threads);
          }
          return nb::make_tuple(result.value, result.active);
        },
        "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "class_ids"_a, "lookup"_a, "stream"_a, "samples"_a,
        "background"_a, "g_means"_a.none(), "g_quats"_a.none(), "g_log_scales"_a.none(), "g_opacity_logits"_a.none(),
        "threads"_a, "weight"_a = 1.0, "skip"_a = true);
  m.def(("brick_sample_" + end).c_str(),
        [](In depth, In to_voxels, uint32_t part) {
          const LiftedView<T> view = lifted_view(depth, to_voxels);
          nb::gil_scoped_release release;
          return brick_sample(view, part);
        },
        "depth"_a, "to_voxels"_a, "part"_a);
  m.def(("sh_colors_" + end).c_str(),
        [](In sh_dc, In sh_rest, In means, const std::vector<double>& center, int degree, Out colors,
           Array<uint8_t> clamped, int threads) {
          ColorJob<T> job = color_job<T>(sh_dc, sh_rest, means, center, degree, clamped);
          job.colors = colors.data();
          nb::gil_scoped_release release;
          sh_colors(job, means.shape(0), threads);
        },
        "sh_dc"_a, "sh_rest"_a, "means"_a, "center"_a, "degree"_a, "colors"_a, "clamped"_a, "threads"_a);
  m.def(("sh_colors_backward_" + end).c_str(),
        [](In sh_dc, In sh_rest, In means, const std::vector<double>& center, int degree, Array<uint8_t> clamped,
           In g_colors, Out g_dc, Out g_rest, Out g_means, int threads) {
          ColorJob<T> job = color_job<T>(sh_dc, sh_rest, means, center, degree, clamped);
          add_gradients(job, g_colors, g_dc, g_rest, g_means);
          nb::gil_scoped_release release;
          sh_colors_backward(job, means.shape(0), threads);
        },
        "sh_dc"_a, "sh_rest"_a, "means"_a, "center"_a, "degree"_a, "clamped"_a, "g_colors"_a, "g_dc"_a.none(),
        "g_rest"_a.none(), "g_means"_a.none(), "threads"_a);
  m.def(("reprojection_votes_" + end).c_str(),
        [](const std::vector<In>& depths, const std::vector<std::optional<Ids>>& labels,
           const std::vector<std::optional<Array<const uint8_t>>>& short_labels, int first, const In& maps,
           const std::vector<Array<int32_t>>& voted, const std::vector<Array<float>>& confidence, int num_classes,
           double tau, int threads) {
          const auto views = voting_views(depths, labels, short_labels);
          const auto targets = voted_views(first, maps, views.size(), voted, confidence);
          nb::gil_scoped_release release;
          reprojection_votes(views, targets, num_classes, tau, threads);
        },
        "depths"_a, "labels"_a, "short_labels"_a, "first"_a, "maps"_a, "voted"_a, "confidence"_a, "num_classes"_a,
        "tau"_a, "threads"_a);
}

}  // namespace

void bind_ops(nb::module_& m) {
  nb::class_<VoxelLookup> lookup(m, "VoxelLookup");
  lookup.def(
      "__init__",
      [](VoxelLookup* self, Array<const int64_t> keys, Ids classes, int num_classes, Array<const double> origin,
         double voxel_size) {
        nb::gil_scoped_release release;
        new (self) VoxelLookup(keys.data(), classes.data(), rows(classes), num_classes, origin.data(), voxel_size);
      },
      "keys"_a, "classes"_a, "num_classes"_a, "origin"_a, "voxel_size"_a);
  lookup.def_prop_ro("bytes", &VoxelLookup::bytes);
  lookup.def("tables", [](const VoxelLookup& self) {  // ops/voxel_lookup.py copies these to a GPU.
    nb::list out;
    const auto bytes = [](const auto& numbers) {
      return nb::bytes(reinterpret_cast<const char*>(numbers.data()), numbers.size() * sizeof numbers[0]);
    };
    for (const VoxelLookup::Bricks* table : self.stored()) {
      const std::vector<int> base(table->base, table->base + 3), size(table->size, table->size + 3);
      out.append(nb::make_tuple(table->num_classes, base, size, bytes(table->dense), bytes(table->slots),
                                bytes(table->ranges)));
    }
    return out;
  });
  bind_lookup<float>(lookup, "f32");
  bind_lookup<double>(lookup, "f64");
  nb::class_<SparseSums> sums(m, "SparseSums");
  sums.def(nb::init<>());
  sums.def_prop_ro("count", [](const SparseSums& self) { return self.keys().size(); });
  sums.def(
      "write",
      [](const SparseSums& self, Array<int64_t> keys, Array<double> sums) {
        std::copy(self.keys().begin(), self.keys().end(), keys.data());
        std::copy(self.sums().begin(), self.sums().end(), sums.data());
      },
      "keys"_a, "sums"_a);
  bind_sums<float>(sums, "f32");
  bind_sums<double>(sums, "f64");
  nb::class_<VoxelVotes> votes(m, "VoxelVotes");
  votes.def(nb::init<int>(), "threads"_a);
  votes.def("decide", &VoxelVotes::decide, nb::call_guard<nb::gil_scoped_release>());
  bind_votes<float>(votes, "f32");
  bind_votes<double>(votes, "f64");
  bind_functions<float>(m, "f32");
  bind_functions<double>(m, "f64");
}

}  // namespace beags
