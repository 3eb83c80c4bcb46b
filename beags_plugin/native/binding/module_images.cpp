// Binds the image losses: plain arrays in and out. beags_plugin/ops checks all arguments, once.
#include "binding/module_images.h"

#include <string>

#include "binding/arrays.h"
#include "binding/op_jobs.h"
#include "ops/normal_consistency.h"
#include "ops/photometric.h"

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
        const PhotometricJob<T> job = photometric_job<T>(image, reference, c1, c2, l1_scale, ssim_scale, gradient);
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
          const NormalJob<T> job = normal_job<T>(depth, normal, alpha, fx, fy, skew, cx, cy, scale, g_depth, g_normal);
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
