"""Decide which class a voxel supports, of those that the views saw in it (method, section 5).

In the paper, one view is enough, and a voxel in which classes collide supports none. A thin part then has no voxel of
its own, and a surface that one view puts at a wrong depth has as many as one that all views agree on. With votes (our
extension), each view that sees a class in a voxel has one.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

MAJORITY = 0.7
"""Of a voxel's votes, exceeded by the class it supports. 0.5 gives contacts away, 0.9 thin parts (docs/results.md)."""
CONFIRMED = 2
"""Votes that an object needs. The background has no such need: at the rim of the scene one view may see it alone."""


class Sightings:
    """The distinct pairs of a voxel and a class that views saw in it, ordered, and how many views did.

    keys: [P] int64, voxels; classes: [P] int32; views: [P] int64.
    """

    def __init__(self, views: Iterable[tuple[Tensor, Tensor]], num_classes: int, device: torch.device) -> None:
        """Count what each view saw: per lifted pixel the key of its voxel and its class, [Q] int64 and int32."""
        none = torch.zeros(0, dtype=torch.int64, device=device)
        self.keys, self.classes, self.views = none, none.int(), none
        for keys, classes in views:
            seen = _distinct(keys, classes, torch.ones_like(keys), num_classes)
            own = (*seen[:2], torch.ones_like(seen[2]))  # one vote, however many pixels
            columns = zip((self.keys, self.classes, self.views), own, strict=True)
            self.keys, self.classes, self.views = _distinct(*map(torch.cat, columns), num_classes)

    def alone(self) -> Tensor:
        """Return [P] bool: no other class was seen in the voxel, as in the paper."""
        _, voxel, classes = torch.unique(self.keys, return_inverse=True, return_counts=True)
        return classes[voxel] == 1

    def by_votes(self) -> Tensor:
        """Return [P] bool: the class has more than ``MAJORITY`` of the voxel's votes, an object's ``CONFIRMED`` too."""
        _, voxel = torch.unique(self.keys, return_inverse=True)
        total = torch.zeros_like(self.views).index_add_(0, voxel, self.views)[voxel]
        first = self.views.double() > MAJORITY * total.double()
        return first & ((self.views >= CONFIRMED) | (self.classes == 0))


def _distinct(keys: Tensor, classes: Tensor, views: Tensor, num_classes: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the distinct pairs, with the sums of ``views``; 64 bits hold a key's rank and a class, but no key."""
    voxels, rank = torch.unique(keys, return_inverse=True)
    pairs, inverse = torch.unique(rank * num_classes + classes, return_inverse=True)
    total = torch.zeros_like(pairs).index_add_(0, inverse, views)
    return voxels[pairs // num_classes], (pairs % num_classes).int(), total
