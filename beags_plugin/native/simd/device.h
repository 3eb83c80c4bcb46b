// Marks functions that the CPU and GPUs share.
#pragma once

#if !defined(BEAGS_ISA) && (defined(__CUDACC__) || defined(BEAGS_CUDA_EMULATION))
#define BEAGS_ISA device  // namespace of shared functions
#endif
#define BEAGS_INLINE inline __attribute__((always_inline))  // the CPU's version
#if defined(__CUDACC__)
#define BEAGS_HD __host__ __device__
#define BEAGS_HD_INLINE __host__ __device__ __forceinline__
#else
#define BEAGS_HD
#define BEAGS_HD_INLINE BEAGS_INLINE
#endif
