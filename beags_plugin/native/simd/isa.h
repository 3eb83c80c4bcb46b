// Which instruction set the kernels are taken from: chosen once a process, at first use.
#pragma once

#include <string>
#include <vector>

#include "rasterizer/types.h"

namespace beags {

// Those that this build holds and this processor can run, best first.
std::vector<std::string> instruction_sets();

// The one in use: the best, or that which the environment variable BEAGS_ISA names. Throws std::runtime_error, a
// sentence for the user, if that one cannot run here.
const std::string& instruction_set();

// Whether that one is AVX2 or comes with it. The ops and image losses have two builds: for AVX2, for any processor.
bool uses_avx2();

// The tile kernels of the one in use.
template <class T>
const Kernels<T>& kernels();

}  // namespace beags
