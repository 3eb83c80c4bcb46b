// Compiles the tile kernels for AVX2 and FMA; empty if the compiler does not use them.
#define BEAGS_ISA avx2
#if defined(__AVX2__) && defined(__FMA__)
#include "rasterizer/tiles.h"
#endif
