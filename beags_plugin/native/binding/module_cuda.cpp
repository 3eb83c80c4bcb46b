// Binds the CUDA rasterizer. rasterizers/cuda.py allocates all memory, checks all arguments once, and names the stream.
#include "binding/module_cuda.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>

#include "binding/arrays.h"
#include "binding/module_cuda_ops.h"
#include "binding/view.h"
#include "cuda/rasterizer/frame.h"
#include "cuda/rasterizer/primitives.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

using namespace cuda;

template <class T>
using Device = Array<T, Memory::kCuda>;

Stream stream_of(uintptr_t stream) { return reinterpret_cast<Stream>(stream); }

// One view's Gaussians and their tiles, for the functions of cuda/rasterizer/frame.h. It owns no memory.
template <class T>
struct Frame {
  View view;
  Inputs<T> inputs;
  Bins<T> bins{};
  Scratch scratch{};
  bool* visible;

  TileJob<T> job() const {
    TileJob<T> job{};
    job.width = view.width;
    job.height = view.height;
    job.tiles_x = tiles_along(view.width);
    job.tiles_y = tiles_along(view.height);
    job.near_plane = static_cast<T>(view.near_plane);
    job.mapping = static_cast<T>(view.mapping());
    job.bins = bins;
    return job;
  }
};

template <class T>
void bind_frame(nb::module_& m, const char* name) {
  using In = Device<const T>;
  using Out = Device<T>;
  using Ints = Device<int32_t>;
  using DeviceIds = Device<const int32_t>;
  nb::class_<Frame<T>> frame(m, name);
  frame.def(
      "__init__",
      [](Frame<T>* self, In means, In quats, In log_scales, In opacity_logits, In colors, DeviceIds class_ids,
         const Matrix& viewmat, const Matrix& k, int width, int height, double near_plane, double far_plane,
         Device<bool> visible, Device<uint8_t> splats, Ints counts, Ints order, Device<int64_t> pair_start,
         Device<int64_t> totals) {
        new (self) Frame<T>{};
        self->view = make_view(viewmat, k, width, height, near_plane, far_plane);
        self->inputs = {means.shape(0),        means.data(),  quats.data(),    log_scales.data(),
                        opacity_logits.data(), colors.data(), class_ids.data()};
        self->visible = visible.data();
        self->bins.splats = reinterpret_cast<Splat<T>*>(splats.data());
        self->bins.counts = counts.data();
        self->bins.order = order.data();
        self->bins.pair_start = pair_start.data();
        self->bins.totals = totals.data();
      },
      "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "class_ids"_a.none(), "viewmat"_a, "K"_a,
      "width"_a, "height"_a, "near"_a, "far"_a, "visible"_a, "splats"_a, "counts"_a, "order"_a, "pair_start"_a,
      "totals"_a);
  frame.def(
      "project",
      [](Frame<T>& self, Device<uint8_t> temporary, Ints keys, Ints sorted, Ints low, Ints values, uintptr_t stream) {
        const Scratch scratch{temporary.data(),
                              static_cast<size_t>(temporary.shape(0)),
                              {reinterpret_cast<uint32_t*>(keys.data()), reinterpret_cast<uint32_t*>(sorted.data()),
                               reinterpret_cast<uint32_t*>(low.data())},
                              values.data()};
        project_gaussians(self.view, self.inputs, self.bins, self.visible, scratch, stream_of(stream));
      },
      "temporary"_a, "keys"_a, "sorted"_a, "low"_a.none(), "values"_a, "stream"_a);
  frame.def(
      "bin",
      [](Frame<T>& self, Ints pair_gaussian, Ints keys, Ints pairs, Ints tile_start, Device<uint8_t> temporary,
         Ints unsorted_keys, Ints unsorted_pairs, uintptr_t stream) {
        self.bins.capacity = pair_gaussian.shape(0);
        self.bins.pair_gaussian = pair_gaussian.data();
        self.bins.keys = reinterpret_cast<uint32_t*>(keys.data());
        self.bins.pairs = pairs.data();
        self.bins.tile_start = tile_start.data();
        const Scratch scratch{temporary.data(),
                              static_cast<size_t>(temporary.shape(0)),
                              {reinterpret_cast<uint32_t*>(unsorted_keys.data()), nullptr, nullptr},
                              unsorted_pairs.data()};
        bin_gaussians(self.view, self.inputs.count, self.bins, scratch, stream_of(stream));
      },
      "pair_gaussian"_a, "keys"_a, "pairs"_a, "tile_start"_a, "temporary"_a, "unsorted_keys"_a, "unsorted_pairs"_a,
      "stream"_a);
  frame.def(
      "forward",
      [](const Frame<T>& self, In background, DeviceIds target, Out color, Out alpha, Out depth, Out median_depth,
         Out normal, Out distortion, Out boundary, Out end_transmittance, Ints end, Out depth_sum, Ints median_pair,
         Out first, Out moment1, Out moment2, uintptr_t stream) {
        TileJob<T> job = self.job();
        job.background = background.data();
        job.target = target.data();
        job.images = {color.data(),  alpha.data(),      depth.data(),   median_depth.data(),
                      normal.data(), distortion.data(), boundary.data()};
        job.kept = {end_transmittance.data(), end.data(),    depth_sum.data(), median_pair.data(), first.data(),
                    moment1.data(),           moment2.data()};
        draw_forward(job, stream_of(stream));
      },
      "background"_a, "target"_a.none(), "color"_a, "alpha"_a, "depth"_a.none(), "median_depth"_a.none(),
      "normal"_a.none(), "distortion"_a.none(), "boundary"_a.none(), "end_transmittance"_a.none(), "end"_a.none(),
      "depth_sum"_a.none(), "median_pair"_a.none(), "first"_a.none(), "moment1"_a.none(), "moment2"_a.none(),
      "stream"_a);
  frame.def(
      "backward",
      [](const Frame<T>& self, In means, In quats, In log_scales, In opacity_logits, In colors, In background,
         DeviceIds target, In color, In alpha, In depth, In median_depth, In normal, In distortion, In boundary,
         Out end_transmittance, Ints end, Out depth_sum, Ints median_pair, Out first, Out moment1, Out moment2,
         Out g_means, Out g_quats, Out g_log_scales, Out g_opacity_logits, Out g_colors, Out g_screen_shift,
         Out g_background, Out records, Device<double> sums, int parts, uintptr_t stream) {
        TileJob<T> job = self.job();
        job.background = background.data();
        job.target = target.data();
        job.gradients = {color.data(),  alpha.data(),      depth.data(),   median_depth.data(),
                         normal.data(), distortion.data(), boundary.data()};
        job.kept = {end_transmittance.data(), end.data(),    depth_sum.data(), median_pair.data(), first.data(),
                    moment1.data(),           moment2.data()};
        job.records = records.data();
        job.g_background = g_background.data();
        draw_backward(job, static_cast<Parts>(parts), stream_of(stream));
        Inputs<T> inputs = self.inputs;
        inputs.means = means.data();
        inputs.quats = quats.data();
        inputs.log_scales = log_scales.data();
        inputs.opacity_logits = opacity_logits.data();
        inputs.colors = colors.data();
        const GaussianGradients<T> to{
            g_means.data(),  g_quats.data(),        g_log_scales.data(), g_opacity_logits.data(),
            g_colors.data(), g_screen_shift.data(), sums.data()};
        reduce_records(self.view, inputs, self.bins, records.data(), backward_record<T>(static_cast<Parts>(parts)), to,
                       stream_of(stream));
      },
      "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "background"_a, "target"_a.none(),
      "color"_a.none(), "alpha"_a.none(), "depth"_a.none(), "median_depth"_a.none(), "normal"_a.none(),
      "distortion"_a.none(), "boundary"_a.none(), "end_transmittance"_a.none(), "end"_a.none(), "depth_sum"_a.none(),
      "median_pair"_a.none(), "first"_a.none(), "moment1"_a.none(), "moment2"_a.none(), "g_means"_a.none(),
      "g_quats"_a.none(), "g_log_scales"_a.none(), "g_opacity_logits"_a.none(), "g_colors"_a.none(),
      "g_screen_shift"_a.none(), "g_background"_a, "records"_a, "sums"_a, "parts"_a, "stream"_a);
  frame.def(
      "class_contributions",
      [](const Frame<T>& self, DeviceIds labels, int num_classes, Device<int64_t> sums, uintptr_t stream) {
        class_contributions(self.job(), labels.data(), num_classes, sums.data(), stream_of(stream));
      },
      "labels"_a, "num_classes"_a, "sums"_a, "stream"_a);
  frame.def(
      "class_map",
      [](const Frame<T>& self, int num_classes, Ints classes, Out share, uintptr_t stream) {
        class_map(self.job(), num_classes, classes.data(), share.data(), stream_of(stream));
      },
      "num_classes"_a, "classes"_a, "share"_a, "stream"_a);
  frame.def(
      "dominant_gaussian",
      [](const Frame<T>& self, Ints indices, uintptr_t stream) {
        dominant_gaussian(self.job(), indices.data(), stream_of(stream));
      },
      "indices"_a, "stream"_a);
  frame.def_prop_ro_static("splat_bytes", [](nb::handle) { return sizeof(Splat<T>); });
  frame.def_static("record_size", [](int parts) { return backward_record<T>(static_cast<Parts>(parts)); });
}

}  // namespace

void bind_cuda(nb::module_& m) {
  m.def("temporary_bytes", &temporary_bytes, "items"_a, "Device memory that sorting so many items takes.");
  m.attr("MOST_TILES") = kMostTiles;
  m.attr("WEIGHT_UNIT") = 1.0 / static_cast<double>(int64_t(1) << kWeightBits);
#if defined(BEAGS_CUDA_EMULATION)
  m.attr("EMULATED") = true;
#else
  m.attr("EMULATED") = false;
  // CUDA's numbering is 1000 major + 10 minor. The query creates no context on a GPU.
  m.def("driver_version", [] {
    int version = 0;
    check(cudaDriverGetVersion(&version), "asking for the driver's version");
    return version;
  });
  m.def("needed_driver_version", [] {
    int version = 0;
    check(cudaRuntimeGetVersion(&version), "asking for the runtime's version");
#if defined(BEAGS_CUDA_PTX_ONLY)  // The driver compiles PTX.
    return version;
#else
    return version / 1000 * 1000;
#endif
  });
#endif
  bind_frame<float>(m, "FrameF32");
  bind_frame<double>(m, "FrameF64");
  bind_cuda_ops(m);
}

}  // namespace beags
