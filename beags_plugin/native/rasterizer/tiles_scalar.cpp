// Compiles the tile kernels for any processor, without SIMD: the base of comparisons.
#define BEAGS_ISA scalar
#define BEAGS_SCALAR
#include "rasterizer/tiles.h"
