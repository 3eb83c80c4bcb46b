// Declares the ops on a GPU. The caller (torch) owns all memory, all work goes to its stream, and nothing waits for the
// GPU.
#pragma once

#if !defined(BEAGS_ISA)
#define BEAGS_ISA device  // namespace of functions shared with the CPU
#endif
#include "cuda/platform.h"
#include "ops/kernels.h"
#include "ops/reprojection_votes.h"
#include "ops/reprojection_votes_terms.h"
#include "ops/voxel_table.h"

namespace beags {
namespace cuda {

template <class T>
void sh_colors(const ops::ColorJob<T>& job, int64_t count, Stream stream);
// Fills the gradients that are not null.
template <class T>
void sh_colors_backward(const ops::ColorJob<T>& job, int64_t count, Stream stream);

// The voxel tables of VoxelLookup, in device memory.
struct Voxels {
  ops::VoxelTable occupied, valid[ops::kLargestCube];
  double origin[3], voxel_size;
};

// See ops/voxel_lookup.h.
template <class T>
void count_occupied(const Voxels& voxels, int64_t count, const T* points, const int32_t* class_ids, int64_t* out,
                    Stream stream);
template <class T>
void is_valid(const Voxels& voxels, int64_t count, const T* points, const int32_t* class_ids, bool* out, Stream stream);
template <class T>
void disc_inside(const Voxels& voxels, int64_t count, const T* means, const T* axes_u, const T* axes_v,
                 const int32_t* class_ids, bool* out, Stream stream);

// Puts bricks into the empty slots of a hash table; a class has no brick twice. ranks: [count], the class of each
// brick.
void hash_bricks(int64_t count, const int32_t* ranks, const ops::Brick* bricks, const ops::BrickRange* classes,
                 ops::Brick* slots, Stream stream);

// votes: counters for the largest target's pixels times num_classes. See ops/reprojection_votes.h.
template <class T>
void reprojection_votes(const std::vector<ops::VotingView<T>>& views, const std::vector<ops::VotedView<T>>& targets,
                        int num_classes, double tau, uint32_t* votes, Stream stream);

// The block size of the occupancy loss. Its job's tables are those of `voxels`.
constexpr int kOccupancyThreads = 128;
// partial: [blocks_for(count, kOccupancyThreads)]; value: [1], the loss times `factor`.
template <class T>
void occupancy_loss(const ops::OccupancyJob<T>& job, const Voxels& voxels, int64_t count, double* partial, T* value,
                    Stream stream);

// See ops/photometric.h. The caller allocates all of the job's memory: `sums` has 2 numbers for each tile of
// kPhotometricTile x kPhotometricTile pixels; `slopes` is needed only with a gradient. value: [1], offset + l1_scale *
// sum |x - y| + ssim_scale * sum of the index.
constexpr int kPhotometricTile = 16;
template <class T>
void photometric(const ops::PhotometricJob<T>& job, double offset, T* value, Stream stream);

// `sums` has a number for each kNormalThreads pixels; `shares` is needed only with gradients. value: [1], the sum times
// scale.
constexpr int kNormalThreads = 256;
template <class T>
void normal_consistency(const ops::NormalJob<T>& job, T* value, Stream stream);

}  // namespace cuda
}  // namespace beags
