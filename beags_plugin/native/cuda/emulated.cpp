// All kernels, compiled for the emulation of CUDA on the CPU.
#if !defined(BEAGS_CUDA_EMULATION)
#error "for the target _cuda_emulation only"
#endif
#include "backward.cu"
#include "forward.cu"
#include "image_losses.cu"
#include "occupancy_loss.cu"
#include "primitives.cu"
#include "products.cu"
#include "project.cu"
#include "reprojection_votes.cu"
#include "sh_colors.cu"
#include "voxel_lookup.cu"
#include "voxel_tally.cu"
