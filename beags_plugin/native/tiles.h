// All kernels of one tile. Included once for each instruction set: nothing here may need code when the program starts,
// or lie outside the namespace BEAGS_ISA, where the linker would merge it with the copies for other processors.
#pragma once

#include "backward.h"
#include "forward.h"
#include "products.h"

namespace beags {
namespace BEAGS_ISA {

#ifdef BEAGS_QUICK
template <class T>
constexpr unsigned quick(unsigned) {
  return 7;
}
#else
template <class T>
constexpr unsigned quick(unsigned p) {
  return variant<T>(p);
}
#endif
template <class T>
constexpr Kernels<T> kernels() {
  return {{forward<quick<T>(0)>, forward<quick<T>(1)>, forward<quick<T>(2)>, forward<quick<T>(3)>, forward<quick<T>(4)>,
           forward<quick<T>(5)>, forward<quick<T>(6)>, forward<quick<T>(7)>},
          {backward<quick<T>(0)>, backward<quick<T>(1)>, backward<quick<T>(2)>, backward<quick<T>(3)>,
           backward<quick<T>(4)>, backward<quick<T>(5)>, backward<quick<T>(6)>, backward<quick<T>(7)>},
          backward_colors<T>,
          class_contributions<T>,
          class_map<T>,
          heaviest<T>,
          count<T>};
}

extern const Kernels<float> kKernelsF32 = kernels<float>();
#ifndef BEAGS_QUICK
extern const Kernels<double> kKernelsF64 = kernels<double>();
#else
extern const Kernels<double> kKernelsF64 = {};
#endif

}  // namespace BEAGS_ISA
}  // namespace beags
