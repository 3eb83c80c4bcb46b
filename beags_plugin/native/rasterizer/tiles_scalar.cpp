// The tile kernels for any processor, without SIMD: what the others are measured against.
#define BEAGS_ISA scalar
#define BEAGS_SCALAR
#include "rasterizer/tiles.h"
