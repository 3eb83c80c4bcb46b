"""The convex hulls of the voxels in which objects were seen (our extension of method, section 5)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beags_plugin.occupancy.grid import VisibilityGrid

HULL_POINTS = 100_000  # of an object, at most
LATTICE = 16  # points along each side of a hull's box
GAP = 2.5  # voxels between those of one cluster
STRAY = 0.05  # of the largest cluster of an object's voxels: smaller ones are no part of it


@dataclass(frozen=True)
class Hull:
    """The convex hull of the voxels in which an object was seen.

    low, high: [3] float64, its box, world. faces: [F, 4] float64, outward unit normals and offsets.
    """

    class_id: int
    volume: float
    low: Tensor
    high: Tensor
    faces: Tensor

    def within(self, points: Tensor, depth: float) -> Tensor:
        """Return int64 indices of the points [P, 3] float64 that lie inside by ``depth`` or more, world units."""
        inside = torch.nonzero(((points >= self.low) & (points <= self.high)).all(1))[:, 0]
        for face in self.faces:
            inside = inside[points[inside] @ face[:3] + face[3] <= -depth]
        return inside

    def meets(self, other: Hull, gap: float) -> bool:
        """Return whether the two boxes are no further apart than ``gap`` along any axis."""
        return bool((torch.maximum(self.low, other.low) <= torch.minimum(self.high, other.high) + gap).all())

    def lattice(self) -> Tensor:
        """Return [P, 3] float64, world, points that fill the box evenly."""
        along = (torch.arange(LATTICE, dtype=torch.float64) + 0.5) / LATTICE
        return self.low + torch.cartesian_prod(along, along, along) * (self.high - self.low)


def hulls_of(grid: VisibilityGrid) -> Iterator[Hull]:
    """Yield the hulls of the objects that have an inside."""
    from scipy.spatial import ConvexHull, QhullError

    for class_id in grid.classes.unique().tolist():
        if class_id == 0:
            continue
        own = grid.centres(grid.keys[grid.classes == class_id]).double().cpu().numpy()
        try:
            hull = ConvexHull(_without_strays(own[:: -(-len(own) // HULL_POINTS)], grid.voxel_size))
        except (QhullError, ValueError):  # few or flat voxels have no inside
            continue
        faces = np.unique(hull.equations, axis=0)
        yield Hull(class_id, hull.volume, *map(torch.from_numpy, (hull.min_bound, hull.max_bound, faces)))


def _without_strays(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """Return the points [P, 3] without the small clusters beside a large one: a stray Gaussian is no part of a hull."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    pairs = cKDTree(points).query_pairs(GAP * voxel_size, output_type="ndarray")
    ones = np.ones(len(pairs), bool)
    _, cluster = connected_components(coo_matrix((ones, pairs.T), shape=(len(points), len(points))), directed=False)
    sizes = np.bincount(cluster, minlength=1)
    return points[sizes[cluster] >= STRAY * sizes.max()]
