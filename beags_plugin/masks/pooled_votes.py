"""The torch version of the compiled ``ops.voxel_votes.VoxelVotes``: its reference and fallback."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

_BITS = 21  # bits of each of the three voxel indices in a key
_HALF = 1 << (_BITS - 1)
_MARGIN = 8  # voxels around a point that are read too
_PARTS = 64  # interpolation weight of a whole voxel: integers, so that sums do not depend on their order
LOOKS = (-2, 2)  # steps along the ray to the places read where votes disagree; a step is at most a voxel


class TorchVotes:
    """See ``ops.voxel_votes.VoxelVotes``."""

    def __init__(self, ignore: int) -> None:
        self._ignore = ignore
        self._pending: list[tuple[Tensor, Tensor]] = []

    def add(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> None:
        points, _, near = lift(depth, to_voxels)
        votes = near & (labels != self._ignore)
        self._pending.append((_keys(torch.floor(points[votes]).long()), labels[votes]))

    def decide(self) -> None:
        device = self._pending[0][0].device if self._pending else None
        keys, labels = zip(*self._pending, strict=True) if self._pending else ((), ())
        empty = torch.zeros(0, dtype=torch.int64, device=device)
        self._voxels, voxel = torch.unique(torch.cat([empty, *keys]), return_inverse=True)
        every = torch.cat([empty, *labels])
        self._classes = int(every.max()) + 1 if len(every) else 1
        # A pair is voxel * classes + label; the pairs of a voxel are consecutive from `_first` on.
        self._pairs, self._votes = torch.unique(voxel * self._classes + every, return_counts=True)
        voxel = self._pairs // self._classes
        counts = torch.bincount(voxel, minlength=len(self._voxels))
        self._first = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
        self._totals = torch.zeros_like(self._voxels).scatter_add_(0, voxel, self._votes)
        leads = 2 * self._votes > self._totals[voxel]
        self._leaders = torch.full_like(self._voxels, -1)  # the class with more than half of a voxel's votes, or -1
        self._leaders[voxel[leads]] = self._pairs[leads] % self._classes

    def read(self, depth: Tensor, to_voxels: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        points, steps, near = lift(depth, to_voxels)
        voted = labels.clone()
        confidence = torch.zeros(depth.shape, dtype=torch.float32, device=depth.device)
        if len(self._voxels):
            voted[near], confidence[near] = self._winners(points[near], steps[near], labels[near])
        return voted, confidence

    def _winners(self, points: Tensor, steps: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
        """Return labels [P] int32 and confidence [P] float32. points, steps: [P, 3], in voxels; labels: [P] int32."""
        voxels, weights, own = self._about(points)
        open_points = torch.nonzero(~self._agree(voxels))[:, 0]
        polls = [self._poll(torch.arange(len(points), device=points.device), voxels, weights)]
        for step in LOOKS:
            moved = points[open_points] + step * steps[open_points]
            polls.append(self._poll(open_points, *self._about(moved)[:2]))
        label, share = self._count(polls, labels)
        # The confidence is the share of votes in the pixel's own voxel, if it has any.
        known = (own >= 0) & (label >= 0) & (label < self._classes)
        pair = own.clamp(min=0) * self._classes + torch.where(known, label, 0)
        at = torch.searchsorted(self._pairs, pair).clamp_(max=len(self._pairs) - 1)
        own_votes = torch.where(known & (self._pairs[at] == pair), self._votes[at], 0)
        own_share = own_votes.float() / self._totals[own.clamp(min=0)].float()
        return label, torch.where(own >= 0, own_share, share)

    def _about(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return indices [8, P] (-1 without votes) and weights [8, P] of the voxels around points [P, 3], and own [P].

        own: index of the voxel that holds each point.
        """
        corner = torch.floor(points - 0.5)
        fraction = (((points - 0.5) - corner) * _PARTS).long()
        numbers, weights = [], []
        for step in itertools.product((0, 1), repeat=3):
            offset = torch.tensor(step, device=points.device)
            weights.append(torch.where(offset == 1, fraction, _PARTS - fraction).prod(-1))
            numbers.append(self._number(corner.long() + offset))
        own = self._number(torch.floor(points).long())
        return torch.stack(numbers), torch.stack(weights), own

    def _number(self, voxels: Tensor) -> Tensor:
        key = _keys(voxels)
        at = torch.searchsorted(self._voxels, key).clamp_(max=len(self._voxels) - 1)
        return torch.where(self._voxels[at] == key, at, -1)

    def _agree(self, voxels: Tensor) -> Tensor:
        """Return whether one class leads in all of a point's voxels [8, P] that have votes, [P] bool."""
        leaders = self._leaders[voxels.clamp(min=0)]
        least = torch.where(voxels >= 0, leaders, self._classes).amin(0)
        return (least >= 0) & (least == torch.where(voxels >= 0, leaders, -1).amax(0))

    def _poll(self, points: Tensor, voxels: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return keys point * classes + label and weighted votes, [M]. points: [P]; voxels, weights: [8, P]."""
        counted = (voxels >= 0) & (weights > 0)
        voxel = voxels[counted]
        counts = self._first[voxel + 1] - self._first[voxel]
        starts = (counts.cumsum(0) - counts).repeat_interleave(counts)
        pair = self._first[voxel].repeat_interleave(counts) + torch.arange(len(starts), device=points.device) - starts
        point = points.expand(8, -1)[counted].repeat_interleave(counts)
        votes = weights[counted].repeat_interleave(counts) * self._votes[pair]
        return point * self._classes + self._pairs[pair] % self._classes, votes

    def _count(self, polls: list[tuple[Tensor, Tensor]], labels: Tensor) -> tuple[Tensor, Tensor]:
        """Return the winners [P] int32 (``labels`` in a tie or without votes) and their share of the votes."""
        keys, votes = (torch.cat(column) for column in zip(*polls, strict=True))
        pairs, inverse = torch.unique(keys, return_inverse=True)
        sums = torch.zeros_like(pairs).scatter_add_(0, inverse, votes)
        point, label = pairs // self._classes, pairs % self._classes
        zeros = torch.zeros(len(labels), dtype=torch.int64, device=labels.device)
        total = zeros.scatter_add(0, point, sums)
        most = zeros.scatter_reduce(0, point, sums, "amax")
        best = sums == most[point]
        leaders = zeros.scatter_add(0, point, best.long())
        winner = zeros.clone()
        winner[point[best]] = label[best]  # A tie does not use it.
        share = most.float() / total.clamp(min=1).float()
        return torch.where(leaders == 1, winner.int(), labels), share


def lift(depth: Tensor, to_voxels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return points [H, W, 3] in voxels, steps along their rays [H, W, 3], and which points can vote [H, W] bool."""
    height, width = depth.shape
    x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
    y = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None] + 0.5
    A, b, voxel = to_voxels[:9].view(3, 3), to_voxels[9:12], to_voxels[12]
    rays = [A[r, 0] * x + (A[r, 1] * y + A[r, 2]) for r in range(3)]
    points = torch.stack([depth * ray + b[r] for r, ray in enumerate(rays)], dim=-1)
    near = (depth > 0) & (points.abs() < _HALF - _MARGIN).all(-1)  # False for NaN
    return points, voxel * torch.stack(rays, dim=-1), near


def _keys(voxels: Tensor) -> Tensor:
    x, y, z = (voxels + _HALF).unbind(-1)
    return x << 2 * _BITS | y << _BITS | z
