// All kernels of one tile. Included once for each instruction set.
#pragma once

#include "backward.h"
#include "forward.h"
#include "products.h"

namespace beags {
namespace BEAGS_ISA {

template <class T>
constexpr Kernels<T> kernels() {
  return {forward<T>, backward<T>, class_contributions<T>, class_map<T>, heaviest<T>};
}

}  // namespace BEAGS_ISA
}  // namespace beags
