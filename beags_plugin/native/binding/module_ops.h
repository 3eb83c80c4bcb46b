// Binds the ops of beags_plugin/ops.
#pragma once

#include <nanobind/nanobind.h>

namespace beags {

void bind_ops(nanobind::module_& m);

}  // namespace beags
