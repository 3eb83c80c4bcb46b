"""What the compiled ``ops.voxel_votes.VoxelVotes`` does, in torch: its reference, and where it is missing."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

_BITS = 21  # of each of the three voxel indices in a key
_HALF = 1 << (_BITS - 1)
_MARGIN = 4  # what is read about a point is in reach too
_ALONG_RAY = (-1, 0, 1)  # where votes are read: voxels behind and before the point
_PARTS = 64  # of a voxel, in interpolation weights: whole numbers, whose sums have no order


class TorchVotes:
    """See ``ops.voxel_votes.VoxelVotes``."""

    def __init__(self, ignore: int) -> None:
        self._ignore = ignore
        self._pending: list[tuple[Tensor, Tensor]] = []

    def add(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> None:
        points, _, near = _lift(depth, to_voxels)
        votes = near & (labels != self._ignore)
        self._pending.append((_keys(torch.floor(points[votes]).long()), labels[votes]))

    def decide(self) -> None:
        device = self._pending[0][0].device if self._pending else None
        keys, labels = zip(*self._pending, strict=True) if self._pending else ((), ())
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        self._voxels, voxel = torch.unique(torch.cat([empty, *keys]), return_inverse=True)
        every = torch.cat([empty, *labels])
        self._classes = int(every.max()) + 1 if len(every) else 1
        pairs, self._votes = torch.unique(voxel * self._classes + every, return_counts=True)
        self._labels = pairs % self._classes
        counts = torch.bincount(pairs // self._classes, minlength=len(self._voxels))
        self._first = torch.cat([counts.new_zeros(1), counts.cumsum(0)])  # of each voxel's pairs

    def read(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        points, rays, near = _lift(depth, to_voxels)
        voted = labels.clone()
        confidence = torch.zeros(depth.shape, dtype=torch.float32, device=depth.device)
        voted[near], confidence[near] = self._winners(points[near], rays[near], labels[near])
        return voted, confidence

    def _winners(self, points: Tensor, rays: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """[P] int32 and [P] float32. points: [P, 3], in voxels; rays: [P, 3], one voxel long; labels: [P] int32."""
        keys, weights = zip(*(self._weighted_votes(points + step * rays - 0.5) for step in _ALONG_RAY), strict=True)
        pairs, inverse = torch.unique(torch.cat(keys), return_inverse=True)
        sums = torch.zeros_like(pairs).scatter_add_(0, inverse, torch.cat(weights))
        point, label = pairs // self._classes, pairs % self._classes
        zeros = torch.zeros(len(points), dtype=torch.int64, device=points.device)
        total = zeros.scatter_add(0, point, sums)
        most = zeros.scatter_reduce(0, point, sums, "amax")
        best = sums == most[point]
        leaders = zeros.scatter_add(0, point, best.long())
        winner = zeros.clone()
        winner[point[best]] = label[best]  # where two lead, the label is not used
        share = most.float() / total.clamp(min=1).float()
        return torch.where(leaders == 1, winner.int(), labels), share

    def _weighted_votes(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Votes of the eight voxels about each point [P, 3]: keys point * classes + label and weighted votes, [M]."""
        corner = torch.floor(points)
        fraction = ((points - corner) * _PARTS).long()
        number = torch.arange(len(points), device=points.device)
        keys, weights = [number[:0]], [number[:0]]
        for step in itertools.product((0, 1), repeat=3):
            offset = torch.tensor(step, device=points.device)
            weight = torch.where(offset == 1, fraction, _PARTS - fraction).prod(-1)
            key = _keys(corner.long() + offset)
            at = torch.searchsorted(self._voxels, key).clamp_(max=max(len(self._voxels) - 1, 0))
            found = (weight > 0) & (self._voxels[at] == key) if len(self._voxels) else weight < 0
            first, count = self._first[at[found]], self._first[at[found] + 1] - self._first[at[found]]
            inside = torch.arange(int(count.sum()), device=points.device) - (count.cumsum(0) - count).repeat_interleave(
                count
            )
            pair = first.repeat_interleave(count) + inside
            keys.append(number[found].repeat_interleave(count) * self._classes + self._labels[pair])
            weights.append(weight[found].repeat_interleave(count) * self._votes[pair])
        return torch.cat(keys), torch.cat(weights)


def _lift(depth: Tensor, to_voxels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points [H, W, 3] in voxels, their rays [H, W, 3] one voxel long, and which of them [H, W] count."""
    height, width = depth.shape
    x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    y = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None] + 0.5
    A, b = to_voxels[:9].view(3, 3), to_voxels[9:]
    rays = [A[r, 0] * x + (A[r, 1] * y + A[r, 2]) for r in range(3)]
    points = torch.stack([depth * ray + b[r] for r, ray in enumerate(rays)], dim=-1)
    length = torch.sqrt(rays[0] * rays[0] + (rays[1] * rays[1] + rays[2] * rays[2]))
    near = (depth > 0) & (points.abs() < _HALF - _MARGIN).all(-1)  # False for NaN
    return points, torch.stack([ray / length for ray in rays], dim=-1), near


def _keys(voxels: Tensor) -> Tensor:
    x, y, z = (voxels + _HALF).unbind(-1)
    return x << 2 * _BITS | y << _BITS | z
