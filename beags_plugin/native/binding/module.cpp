// Binds the rasterizer and defines the module _native: plain arrays in and out. rasterizers/native.py and interface.py
// check all arguments, once.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <string>
#include <vector>

#include "binding/arrays.h"
#if defined(BEAGS_HAS_CUDA)
#include "binding/module_cuda.h"
#endif
#include "binding/module_images.h"
#include "binding/module_ops.h"
#include "binding/view.h"
#include "rasterizer/frame.h"
#include "simd/isa.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

template <class T, class In>
Inputs<T> make_inputs(const In& means, const In& quats, const In& log_scales, const In& opacity_logits,
                      const In& colors, const int32_t* class_ids) {
  return {static_cast<int64_t>(means.shape(0)),
          means.data(),
          quats.data(),
          log_scales.data(),
          opacity_logits.data(),
          colors.data(),
          class_ids};
}

template <class T>
void bind(nb::module_& m, const char* name) {
  using In = Array<const T>;
  using Out = Array<T>;
  nb::class_<Contributions<T>>(m, (std::string("Contributions") + name).c_str())
      .def_prop_ro("count", [](const Contributions<T>& self) { return self.keys.size(); })
      .def(
          "write",
          [](const Contributions<T>& self, Array<int64_t> keys, Out values) {
            std::copy(self.keys.begin(), self.keys.end(), keys.data());
            std::copy(self.values.begin(), self.values.end(), values.data());
          },
          "keys"_a, "values"_a);
  nb::class_<Frame<T>>(m, name)
      .def(
          "__init__",
          [](Frame<T>* self, In means, In quats, In log_scales, In opacity_logits, In colors, Ids class_ids,
             const Matrix& viewmat, const Matrix& k, int width, int height, double near_plane, double far_plane,
             Array<bool> visible, int threads) {
            const View view = make_view(viewmat, k, width, height, near_plane, far_plane);
            const Inputs<T> inputs = make_inputs<T>(means, quats, log_scales, opacity_logits, colors, class_ids.data());
            nb::gil_scoped_release release;
            new (self) Frame<T>(view, inputs, visible.data(), threads);
          },
          "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "class_ids"_a.none(), "viewmat"_a,
          "K"_a, "width"_a, "height"_a, "near"_a, "far"_a, "visible"_a, "threads"_a)
      .def_prop_ro("num_nonfinite", &Frame<T>::num_nonfinite)
      .def(
          "forward",
          [](Frame<T>& self, In background, Ids target, Out color, Out alpha, Out depth, Out median_depth, Out normal,
             Out distortion, Out boundary, bool keep, int threads) {
            nb::gil_scoped_release release;
            self.forward({color.data(), alpha.data(), depth.data(), median_depth.data(), normal.data(),
                          distortion.data(), boundary.data()},
                         background.data(), target.data(), keep, threads);
          },
          "background"_a, "target"_a.none(), "color"_a, "alpha"_a, "depth"_a.none(), "median_depth"_a.none(),
          "normal"_a.none(), "distortion"_a.none(), "boundary"_a.none(), "keep"_a, "threads"_a)
      .def(
          "backward",
          [](const Frame<T>& self, In means, In quats, In log_scales, In opacity_logits, In colors, Ids target,
             In color, In alpha, In depth, In median_depth, In normal, In distortion, In boundary, Out g_means,
             Out g_quats, Out g_log_scales, Out g_opacity_logits, Out g_colors, Out g_screen_shift, Out g_background,
             int threads) {
            const Inputs<T> inputs = make_inputs<T>(means, quats, log_scales, opacity_logits, colors, nullptr);
            nb::gil_scoped_release release;
            self.backward(inputs, target.data(),
                          {color.data(), alpha.data(), depth.data(), median_depth.data(), normal.data(),
                           distortion.data(), boundary.data()},
                          {g_means.data(), g_quats.data(), g_log_scales.data(), g_opacity_logits.data(),
                           g_colors.data(), g_screen_shift.data(), g_background.data()},
                          threads);
          },
          "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "target"_a.none(), "color"_a.none(),
          "alpha"_a.none(), "depth"_a.none(), "median_depth"_a.none(), "normal"_a.none(), "distortion"_a.none(),
          "boundary"_a.none(), "g_means"_a.none(), "g_quats"_a.none(), "g_log_scales"_a.none(),
          "g_opacity_logits"_a.none(), "g_colors"_a.none(), "g_screen_shift"_a.none(), "g_background"_a.none(),
          "threads"_a)
      .def(
          "class_contributions",
          [](const Frame<T>& self, Ids labels, int num_classes, Out out, int threads) {
            nb::gil_scoped_release release;
            self.class_contributions(labels.data(), num_classes, out.data(), threads);
          },
          "labels"_a, "num_classes"_a, "out"_a, "threads"_a)
      .def(
          "sparse_class_contributions",
          [](const Frame<T>& self, Ids labels, int num_classes, int threads) {
            nb::gil_scoped_release release;
            return self.sparse_class_contributions(labels.data(), num_classes, threads);
          },
          "labels"_a, "num_classes"_a, "threads"_a)
      .def(
          "sparse_class_pixel_counts",
          [](const Frame<T>& self, Ids labels, int num_classes, double min_weight, int threads) {
            nb::gil_scoped_release release;
            return self.sparse_class_pixel_counts(labels.data(), num_classes, static_cast<T>(min_weight), threads);
          },
          "labels"_a, "num_classes"_a, "min_weight"_a, "threads"_a)
      .def(
          "sparse_top_contributions",
          [](const Frame<T>& self, Ids labels, int num_classes, int most, int within, int threads) {
            nb::gil_scoped_release release;
            return self.sparse_top_contributions(labels.data(), num_classes, most, within, threads);
          },
          "labels"_a, "num_classes"_a, "most"_a, "within"_a, "threads"_a)
      .def(
          "class_map",
          [](const Frame<T>& self, int num_classes, Array<int32_t> classes, Out share, int threads) {
            nb::gil_scoped_release release;
            self.class_map(num_classes, classes.data(), share.data(), threads);
          },
          "num_classes"_a, "classes"_a, "share"_a, "threads"_a)
      .def(
          "class_channels",
          [](Frame<T>& self, int num_classes, Out channels, bool keep, int threads) {
            nb::gil_scoped_release release;
            self.class_channels(num_classes, channels.data(), keep, threads);
          },
          "num_classes"_a, "channels"_a, "keep"_a, "threads"_a)
      .def(
          "class_channels_backward",
          [](const Frame<T>& self, In means, In quats, In log_scales, In opacity_logits, In colors, In gradient,
             Out g_means, Out g_quats, Out g_log_scales, Out g_opacity_logits, Out g_screen_shift, int threads) {
            const Inputs<T> inputs = make_inputs<T>(means, quats, log_scales, opacity_logits, colors, nullptr);
            nb::gil_scoped_release release;
            self.class_channels_backward(inputs, static_cast<int>(gradient.shape(2)), gradient.data(),
                                         {g_means.data(), g_quats.data(), g_log_scales.data(), g_opacity_logits.data(),
                                          nullptr, g_screen_shift.data(), nullptr},
                                         threads);
          },
          "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "gradient"_a, "g_means"_a.none(),
          "g_quats"_a.none(), "g_log_scales"_a.none(), "g_opacity_logits"_a.none(), "g_screen_shift"_a.none(),
          "threads"_a)
      .def(
          "feature_channels",
          [](Frame<T>& self, In features, Out channels, bool keep, int threads) {
            nb::gil_scoped_release release;
            self.feature_channels(features.data(), static_cast<int>(features.shape(1)), channels.data(), keep, threads);
          },
          "features"_a, "channels"_a, "keep"_a, "threads"_a)
      .def(
          "feature_channels_backward",
          [](const Frame<T>& self, In means, In quats, In log_scales, In opacity_logits, In colors, In features,
             In gradient, Out g_means, Out g_quats, Out g_log_scales, Out g_opacity_logits, Out g_screen_shift,
             Out g_features, int threads) {
            const Inputs<T> inputs = make_inputs<T>(means, quats, log_scales, opacity_logits, colors, nullptr);
            nb::gil_scoped_release release;
            self.feature_channels_backward(inputs, features.data(), static_cast<int>(features.shape(1)),
                                           gradient.data(),
                                           {g_means.data(), g_quats.data(), g_log_scales.data(),
                                            g_opacity_logits.data(), nullptr, g_screen_shift.data(), nullptr},
                                           g_features.data(), threads);
          },
          "means"_a, "quats"_a, "log_scales"_a, "opacity_logits"_a, "colors"_a, "features"_a, "gradient"_a,
          "g_means"_a.none(), "g_quats"_a.none(), "g_log_scales"_a.none(), "g_opacity_logits"_a.none(),
          "g_screen_shift"_a.none(), "g_features"_a.none(), "threads"_a)
      .def(
          "dominant_gaussian",
          [](const Frame<T>& self, Array<int32_t> indices, int threads) {
            nb::gil_scoped_release release;
            self.dominant_gaussian(indices.data(), threads);
          },
          "indices"_a, "threads"_a)
      .def(
          "work_counts",
          [](const Frame<T>& self, int threads) {
            const WorkCounts counts = self.work_counts(threads);
            return nb::make_tuple(counts.lanes, counts.contributing, counts.tile_pairs, counts.box_pairs);
          },
          "threads"_a);
}

}  // namespace
}  // namespace beags

NB_MODULE(_native, m) {
  nb::set_leak_warnings(false);  // An image that is alive at exit keeps its frame alive, through autograd.
  m.doc() = "The CPU rasterizer and the ops; use them through beags_plugin.rasterizers.native and beags_plugin.ops.";
  m.def("instruction_set", &beags::instruction_set, "The kernels in use; RuntimeError if those asked for cannot run.");
  m.def("instruction_sets", &beags::instruction_sets, "Those that can run here, best first.");
  beags::bind<float>(m, "FrameF32");
  beags::bind<double>(m, "FrameF64");
  beags::bind_ops(m);
  beags::bind_images(m);
#if defined(BEAGS_HAS_CUDA)
  nb::module_ cuda = m.def_submodule("cuda", "The CUDA backend; use it through beags_plugin.rasterizers.cuda.");
  beags::bind_cuda(cuda);
#endif
}
