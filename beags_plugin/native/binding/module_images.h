// Binds the image losses of beags_plugin/ops.
#pragma once

#include <nanobind/nanobind.h>

namespace beags {

void bind_images(nanobind::module_& m);

}  // namespace beags
