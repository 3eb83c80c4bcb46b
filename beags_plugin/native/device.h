// Functions that the CPU and GPUs share.
#pragma once

#if defined(__CUDACC__)
#define BEAGS_HD __host__ __device__
#else
#define BEAGS_HD
#endif
