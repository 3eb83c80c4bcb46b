// The tile kernels for processors with AVX-512; empty where the compiler was not told to use them.
#define BEAGS_ISA avx512
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#include "rasterizer/tiles.h"
#endif
