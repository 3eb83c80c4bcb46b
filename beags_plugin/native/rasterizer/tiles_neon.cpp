// Compiles the tile kernels for 64-bit Arm processors; empty elsewhere.
#define BEAGS_ISA neon
#if defined(__aarch64__)
#include "rasterizer/tiles.h"
#endif
