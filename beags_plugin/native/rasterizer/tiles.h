// Lists all kernels of one tile. Included once for each instruction set: nothing here may run code when the program
// starts, or lie outside the namespace BEAGS_ISA, where the linker would merge it with the copies for other processors.
#pragma once

#include "rasterizer/backward.h"
#include "rasterizer/features.h"
#include "rasterizer/forward.h"
#include "rasterizer/queries.h"

namespace beags {
namespace BEAGS_ISA {

// Returns the variant that renders `parts`; float64 and kernels without SIMD, which serve checks and comparisons, have
// only the complete variant.
template <class T>
constexpr Parts variant([[maybe_unused]] Parts parts) {
#if defined(BEAGS_SCALAR)
  return kAllParts;
#else
  return sizeof(T) == sizeof(double) ? kAllParts : parts;
#endif
}

template <Parts kWanted, class T>
constexpr Variant<T> make_variant() {
  constexpr Parts kComputed = variant<T>(kWanted);
  return {forward<kComputed, T>, backward<kComputed, T>, record_size(kComputed)};
}

template <class T>
constexpr Kernels<T> make_kernels() {
  return {{make_variant<0, T>(), make_variant<1, T>(), make_variant<2, T>(), make_variant<3, T>(), make_variant<4, T>(),
           make_variant<5, T>(), make_variant<6, T>(), make_variant<7, T>()},
          backward_colors<false, T>,
          feature_channels<T>,
          backward<kFeatures, T>,
          backward_colors<true, T>,
          class_sums<false, T>,
          class_sums<true, T>,
          top_contributions<T>,
          class_map<T>,
          class_channels<T>,
          class_channels_backward<T>,
          dominant_gaussian<T>,
          count<T>};
}

extern constexpr Kernels<float> kKernelsF32 = make_kernels<float>();
extern constexpr Kernels<double> kKernelsF64 = make_kernels<double>();

}  // namespace BEAGS_ISA
}  // namespace beags
