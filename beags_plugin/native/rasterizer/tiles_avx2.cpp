// The tile kernels for processors with AVX2 and FMA; empty where the compiler was not told to use them.
#define BEAGS_ISA avx2
#if defined(__AVX2__) && defined(__FMA__)
#include "rasterizer/tiles.h"
#endif
