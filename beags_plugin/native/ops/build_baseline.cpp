// Compiles the ops' kernels for any processor.
#define BEAGS_ISA baseline
#include "ops/tables.h"
