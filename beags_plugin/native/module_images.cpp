// The image losses as Python sees them: plain arrays in and out. Arguments are checked once, in beags_plugin/ops.
#include "module_images.h"

#include <string>

#include "arrays.h"
#include "image_losses.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace beags {
namespace {

using namespace ops;

template <class T>
void bind(nb::module_& m, const std::string& suffix) {
  using In = Array<const T>;
  using Out = Array<T>;
  m.def(
      ("photometric_" + suffix).c_str(),
      [](In image, In reference, double c1, double c2, double l1_scale, double ssim_scale, Out gradient, int threads) {
        PhotometricJob<T> job{};
        job.height = static_cast<int>(image.shape(0));
        job.width = static_cast<int>(image.shape(1));
        job.image = image.data();
        job.reference = reference.data();
        job.c1 = static_cast<T>(c1);
        job.c2 = static_cast<T>(c2);
        job.l1_scale = static_cast<T>(l1_scale);
        job.ssim_scale = static_cast<T>(ssim_scale);
        job.gradient = gradient.data();
        PhotometricSums sums;
        {
          nb::gil_scoped_release release;
          sums = photometric(job, threads);
        }
        return nb::make_tuple(sums.absolute, sums.similar);
      },
      "image"_a, "reference"_a, "c1"_a, "c2"_a, "l1_scale"_a, "ssim_scale"_a, "gradient"_a.none(), "threads"_a);
  m.def(("normal_consistency_" + suffix).c_str(),
        [](In depth, In normal, In alpha, double fx, double fy, double skew, double cx, double cy, double scale,
           Out g_depth, Out g_normal, int threads) {
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
          nb::gil_scoped_release release;
          return normal_consistency(job, threads);
        },
        "depth"_a, "normal"_a, "alpha"_a, "fx"_a, "fy"_a, "skew"_a, "cx"_a, "cy"_a, "scale"_a, "g_depth"_a.none(),
        "g_normal"_a.none(), "threads"_a);
}

}  // namespace

void bind_images(nb::module_& m) {
  bind<float>(m, "f32");
  bind<double>(m, "f64");
}

}  // namespace beags
