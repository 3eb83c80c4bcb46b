"""Votes for classes, pooled per voxel of the points that cast them and read back softly (method, section 2)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension, extension
from beags_plugin.ops.voxel_tally import VoxelTally


class VoxelVotes:
    """Counts votes per (voxel, class), then gives each pixel the class that leads around its point.

    A pixel (x, y) at depth d lies at d A (x, y, 1) + b, in voxels; ``to_voxels`` [13] is A row by row, b, and the depth
    of one step of ``masks.pooled_votes.LOOKS``. Pixels whose depth is not positive and finite, or whose point is
    2^20 - 8 voxels or more from 0 along an axis, neither vote nor get an answer. ``masks.voxel_reprojection`` describes
    how votes are read. Memory is linear in the voxels; the number of classes costs neither time nor memory.

    ignore: the label that does not vote. tally: memory on a GPU that then holds all tensors but ``to_voxels``, or None
        for the CPU. The results are the same.
    """

    def __init__(self, ignore: int, tally: VoxelTally | None = None) -> None:
        self._ignore, self._tally = ignore, tally
        self._native: Any = extension.module().VoxelVotes(extension.threads()) if tally is None else None

    def add(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> None:
        """Add one vote of each pixel. depth: [H, W] float32 or float64; labels: [H, W] int32, 0 or more."""
        depth, to_voxels = _view(depth, to_voxels)
        labels = extension.plain("labels", labels, tuple(depth.shape), torch.int32)
        if self._tally is not None:
            self._tally.add_pixels(depth, to_voxels.cpu(), labels, self._ignore)
        else:
            extension.function("add", depth, self._native)(depth, to_voxels, labels, self._ignore)

    def decide(self) -> None:
        """Decide each voxel; call it after all votes and before ``read``."""
        (self._tally or self._native).decide()

    def read(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the class that leads around each pixel's point, and its share of the votes.

        A pixel keeps its label where several classes lead or there are no votes. The share is that of the votes in the
        voxel of the point, or, if it has none, of the votes that were read.

        depth: [H, W] float. labels: [H, W] int32.
        Returns [H, W] int32 and [H, W] float32 (0 where there are no votes).
        """
        depth, to_voxels = _view(depth, to_voxels)
        labels = extension.plain("labels", labels, tuple(depth.shape), torch.int32).clone()
        if self._tally is not None:
            return labels, self._tally.read(depth, to_voxels.cpu(), labels)
        confidence = torch.empty(tuple(depth.shape), dtype=torch.float32)
        extension.function("read", depth, self._native)(depth, to_voxels, labels, confidence)
        return labels, confidence


def brick_sample(depth: Tensor, to_voxels: Tensor, part: int) -> Tensor:
    """Sample depth [H, W] on the CPU as ``masks.spatial_chunks.torch_brick_sample``.

    The caller checks ``extension.supports(depth)`` first."""
    depth, to_voxels = _view(depth, to_voxels)
    bricks = extension.function("brick_sample", depth)(depth, to_voxels, part)
    return torch.tensor(bricks, dtype=torch.int64).reshape(-1, 3)


def votes_for(depths: Sequence[Tensor], ignore: int) -> VoxelVotes | None:
    """Return the compiled counter of votes for depths on this device; None if there is none."""
    if (module := cuda_extension.module_for(*depths)) is not None:
        return VoxelVotes(ignore, VoxelTally(module, depths[0].device))
    return VoxelVotes(ignore) if extension.supports(*depths) else None


def _view(depth: Tensor, to_voxels: Tensor) -> tuple[Tensor, Tensor]:
    depth = extension.plain("depth", depth, (depth.shape[0], depth.shape[1]), depth.dtype)
    return depth, extension.plain("to_voxels", to_voxels, (13,), depth.dtype)
