// The image losses' kernels for any processor.
#define BEAGS_ISA baseline
#include "image_tables.h"
