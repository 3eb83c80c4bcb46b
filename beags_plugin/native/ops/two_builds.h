// Chooses between the two builds of the ops' kernels: for any processor, and for AVX2 with FMA.
#pragma once

namespace beags {

bool uses_avx2();  // isa.h

namespace ops {

// Returns the table of one build; a file compiled for it defines this for Kernels of float and double.
namespace baseline {
template <class Kernels>
const Kernels& table();
}  // namespace baseline
namespace avx2 {
template <class Kernels>
const Kernels& table();
}  // namespace avx2

// Returns the table to use in this process.
template <class Kernels>
const Kernels& best_table() {
#if defined(BEAGS_HAS_AVX2)
  if (uses_avx2()) return avx2::table<Kernels>();
#endif
  return baseline::table<Kernels>();
}

}  // namespace ops
}  // namespace beags
