"""Multiview mask reprojection through fine voxels: one vote a pixel, O(views x pixels) (method, section 2)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.masks.reprojection import ReprojectedMask, check_views
from beags_plugin.ops import extension
from beags_plugin.ops.voxel_votes import VoxelVotes
from beags_plugin.rasterizers.interface import IGNORE

VOXEL_PIXELS = 2.0  # side of a voxel, in pixels seen at the median depth
_HALF = 1 << 20  # 21 bits for each of the three voxel indices in a key


def reproject_voxel(
    depths: Sequence[Tensor],
    cameras: Sequence[Camera],
    labels: Sequence[Tensor | None],
    num_classes: int,
    tau: float = 0.02,
    progress: Callable[[int, int], None] | None = None,
) -> list[ReprojectedMask]:
    """Give every pixel of every view the class that most lifted pixels of all views put into its voxel.

    Arguments and results are those of ``reprojection.reproject_pairwise``, and so is what a tie does. The points are
    lifted from what each view sees, so no vote passes through a surface and ``tau`` is not used: a vote counts in its
    voxel, whose side is ``VOXEL_PIXELS`` pixels at the median depth. What lies much farther away is voted on by few.
    Cost O(V pixels), memory linear in the voxels.
    """
    check_views(depths, cameras, labels, num_classes, tau)
    if not cameras:
        return []
    size = _voxel_size(depths, cameras)
    origin = _origin(cameras)
    votes = VoxelVotes(origin, size) if extension.can_take(*depths) else _TorchVotes(origin, size)
    views = len(cameras)
    for i, (depth, camera, mask) in enumerate(zip(depths, cameras, labels, strict=True)):
        if mask is not None:
            known = _drawn(depth) & (mask != IGNORE)
            votes.add(lift(depth, camera)[known], mask[known].int())
        if progress:
            progress(i + 1, 2 * views)
    votes.decide()
    results = []
    for i, (depth, camera, mask) in enumerate(zip(depths, cameras, labels, strict=True)):
        shape = (camera.height, camera.width)
        voted = (
            torch.full(shape, IGNORE, dtype=torch.int32, device=depth.device) if mask is None else mask.int().clone()
        )
        confidence = torch.zeros(shape, dtype=torch.float32, device=depth.device)
        drawn = _drawn(depth)
        voted[drawn], confidence[drawn] = votes.read(lift(depth, camera)[drawn], voted[drawn])
        results.append(ReprojectedMask(voted, confidence))
        if progress:
            progress(views + i + 1, 2 * views)
    return results


def _drawn(depth: Tensor) -> Tensor:
    return (depth > 0) & depth.isfinite()


def _voxel_size(depths: Sequence[Tensor], cameras: Sequence[Camera]) -> float:
    """``VOXEL_PIXELS`` times the median of depth / focal length over the pixels that are drawn; world units."""
    footprints = []
    for depth, camera in zip(depths, cameras, strict=True):
        focal = (float(camera.K[0, 0]) * float(camera.K[1, 1])) ** 0.5
        footprints.append((depth[_drawn(depth)] / focal).double().cpu())
    every = torch.cat(footprints)
    return VOXEL_PIXELS * float(every.median()) if len(every) else 1.0


def _origin(cameras: Sequence[Camera]) -> Tensor:
    """[3] float64: amid the cameras, as the keys reach equally far to all sides."""
    return torch.stack([camera.to("cpu", torch.float64).center for camera in cameras]).mean(0)


class _TorchVotes:
    """What ``ops.voxel_votes.VoxelVotes`` does, in torch; its reference."""

    def __init__(self, origin: Tensor, voxel_size: float) -> None:
        self._origin, self._size = origin, voxel_size
        self._pending: list[tuple[Tensor, Tensor]] = []

    def _keys(self, points: Tensor) -> Tensor:
        """[P] int64, -1 for points that are not finite or too far away."""
        index = torch.floor((points - self._origin.to(points)) / self._size)
        near = (index.abs() < _HALF).all(-1)
        x, y, z = (torch.where(near[:, None], index, torch.zeros_like(index)).long() + _HALF).unbind(-1)
        return torch.where(near, x << 42 | y << 21 | z, -1)

    def add(self, points: Tensor, labels: Tensor) -> None:
        keys = self._keys(points)
        self._pending.append((keys[keys >= 0], labels[keys >= 0]))

    def decide(self) -> None:
        device = self._pending[0][0].device if self._pending else None
        keys, labels = zip(*self._pending, strict=True) if self._pending else ((), ())
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        self._voxels, voxel = torch.unique(torch.cat([empty, *keys]), return_inverse=True)
        every = torch.cat([empty, *labels])
        classes = int(every.max()) + 1 if len(every) else 1
        pairs, counts = torch.unique(voxel * classes + every, return_counts=True)
        voxel, label = pairs // classes, pairs % classes
        zeros = torch.zeros(len(self._voxels), dtype=torch.int64, device=device)
        self._total = zeros.scatter_add(0, voxel, counts)
        self._most = zeros.scatter_reduce(0, voxel, counts, "amax")
        best = counts == self._most[voxel]
        self._leaders = zeros.scatter_add(0, voxel, best.long())
        self._winner = zeros.clone()
        self._winner[voxel[best]] = label[best]  # where two lead, the label is not used

    def read(self, points: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        keys = self._keys(points)
        confidence = torch.zeros(len(keys), dtype=torch.float32, device=points.device)
        if len(self._voxels) == 0:
            return labels, confidence
        at = torch.searchsorted(self._voxels, keys).clamp_(max=len(self._voxels) - 1)
        found = self._voxels[at] == keys
        clear = found & (self._leaders[at] == 1)
        share = self._most[at].float() / self._total[at].float()
        return torch.where(clear, self._winner[at].int(), labels), torch.where(found, share, confidence)
