// Compiles the tile kernels for AVX-512; empty if the compiler does not use it.
#define BEAGS_ISA avx512
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#include "rasterizer/tiles.h"
#endif
