// Chooses the instruction set of the kernels, once a process, at first use.
#pragma once

#include <string>
#include <vector>

#include "rasterizer/types.h"

namespace beags {

// Returns the sets that this build holds and this processor can run, best first.
std::vector<std::string> instruction_sets();

// Returns the set in use: the best, or the one that the environment variable BEAGS_ISA names. Throws
// std::runtime_error, a sentence for the user, if that one cannot run here.
const std::string& instruction_set();

// Returns whether that set is AVX2 or includes it. The ops have two builds: for AVX2, and for any processor.
bool uses_avx2();

// Returns the tile kernels of the set in use.
template <class T>
const Kernels<T>& kernels();

}  // namespace beags
