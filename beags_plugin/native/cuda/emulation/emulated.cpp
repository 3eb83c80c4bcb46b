// Compiles all kernels for the emulation of CUDA on the CPU.
#if !defined(BEAGS_CUDA_EMULATION)
#error "for the target _cuda_emulation only"
#endif
#include "cuda/ops/normal_consistency.cu"
#include "cuda/ops/occupancy_loss.cu"
#include "cuda/ops/photometric.cu"
#include "cuda/ops/reprojection_votes.cu"
#include "cuda/ops/sh_colors.cu"
#include "cuda/ops/voxel_lookup.cu"
#include "cuda/ops/voxel_votes.cu"
#include "cuda/rasterizer/backward.cu"
#include "cuda/rasterizer/forward.cu"
#include "cuda/rasterizer/primitives.cu"
#include "cuda/rasterizer/project.cu"
#include "cuda/rasterizer/queries.cu"
