// The ops of the CUDA backend as Python sees them. Arguments are checked once, in beags_plugin/ops.
#include "module_cuda_ops.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>

#include "../arrays.h"
#include "../op_jobs.h"
#include "ops.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

using namespace cuda;
using ops::add_gradients;
using ops::color_job;
using ops::ColorJob;
using ops::occupancy_job;
using ops::OccupancyJob;
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
  bind<float>(m, "f32");
  bind<double>(m, "f64");
}

}  // namespace beags
