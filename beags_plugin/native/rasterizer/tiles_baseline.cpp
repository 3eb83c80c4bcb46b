// Compiles the tile kernels for any processor.
#define BEAGS_ISA baseline
#include "rasterizer/tiles.h"
