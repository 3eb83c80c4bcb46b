"""Votes for classes, pooled per voxel of the points that cast them (method, section 2)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import extension


class VoxelVotes:
    """Counts votes per (voxel, class), then tells each voxel's winner; memory is linear in the voxels.

    Points that are not finite, or 2^20 voxels or more from ``origin`` along an axis, neither vote nor are told.

    origin: [3] float64, corner of voxel (0, 0, 0), world. voxel_size: world units.
    """

    def __init__(self, origin: Tensor, voxel_size: float) -> None:
        module = extension.load()
        assert module is not None, "the caller asks extension.load() first"
        origin = extension.plain("origin", origin, (3,), torch.float64)
        self._native: Any = module.VoxelVotes(origin, voxel_size, extension.threads())

    def add(self, points: Tensor, labels: Tensor) -> None:
        """One vote of each point. points: [P, 3] float32 or float64, world; labels: [P] int32, 0 or more."""
        points = extension.plain("points", points, (len(points), 3), points.dtype)
        labels = extension.plain("labels", labels, (len(points),), torch.int32)
        extension.function("add", points, self._native)(points, labels)

    def decide(self) -> None:
        """All votes are in; now and only now ``read`` may be asked."""
        self._native.decide()

    def read(self, points: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """The winner of each point's voxel (``labels`` where several lead or nobody voted), and its share of the votes.

        points: [P, 3] float; labels: [P] int32. Returns [P] int32 and [P] float32 (0 where nobody voted).
        """
        points = extension.plain("points", points, (len(points), 3), points.dtype)
        labels = extension.plain("labels", labels, (len(points),), torch.int32).clone()
        confidence = torch.empty(len(points), dtype=torch.float32)
        extension.function("read", points, self._native)(points, labels, confidence)
        return labels, confidence
