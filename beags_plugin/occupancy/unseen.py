"""Space that no view has seen is no evidence against a Gaussian (our extension of method, section 5).

In the paper a voxel supports a class only where a view has seen it: space inside things, under them and outside of all
views counts like space that was seen to be empty. Here a voxel in which no surface was seen, and through which no ray
has passed, supports the object whose convex hull it lies in, the smallest one; else the background. Hulls are a voxel
smaller, so that both sides of a contact keep their surfaces.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift, project
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import RADIUS

TAU = 0.02  # of the depth: a ray has not passed what lies so little before its surface, as in reprojection (E5)
MARGIN = 1.5  # voxels, likewise
MOST_POINTS = 4096  # of a disc, to find the voxels that it reaches into
HULL_POINTS = 100_000  # of an object, at most
GAP = 2.5  # voxels between those of one cluster
STRAY = 0.05  # of the largest cluster of an object's voxels: smaller ones are no part of it
_CHUNK_POINTS = 1 << 20  # at a time


class SeenSurface(Protocol):
    """What a training view shows."""

    @property
    def camera(self) -> Camera:
        """Return the camera."""
        ...

    def surface(self) -> Tensor:
        """Return [H, W] float, the depth of the surface; 0 where nothing is solid."""
        ...


def with_unseen(
    grid: VisibilityGrid, surfels: Surfels, class_ids: Tensor, views: Iterable[SeenSurface]
) -> VisibilityGrid:
    """Return the grid with the unseen voxels that Gaussians reach into.

    surfels: N Gaussians; class_ids: [N] int32, phi. views: the training views, read twice.
    """
    reached = torch.cat([*_reached(grid, surfels, class_ids), grid.keys[:0]]).unique()
    keys = reached[~torch.isin(reached, _seen(grid, views))]
    centres = grid.centres(keys)
    for view in views:
        passed = _passed(centres, view, MARGIN * grid.voxel_size)
        keys, centres = keys[~passed], centres[~passed]
    keys, order = torch.cat([grid.keys, keys]).sort()
    classes = torch.cat([grid.classes, _innermost(grid, centres)])[order]
    return VisibilityGrid(grid.voxel_size, grid.origin, grid.num_classes, keys, classes)


def _reached(grid: VisibilityGrid, surfels: Surfels, class_ids: Tensor) -> Iterator[Tensor]:
    """Yield keys of the voxels that discs reach into and that do not support their class."""
    scales = RADIUS * surfels.log_scales.exp() / grid.voxel_size  # half axes, voxels
    # Points less than two voxels apart over the area, and along discs that are nearly lines; voxels next to a
    # supported one are valid.
    wanted = torch.maximum(torch.pi / 2 * scales.prod(dim=1), 2 * scales.amax(dim=1)).nan_to_num(nan=0.0)
    last = 0.0
    for count in (16, 64, 256, 1024, MOST_POINTS):
        most = count if count < MOST_POINTS else torch.inf
        chosen = torch.nonzero((wanted > last) & (wanted <= most))[:, 0]
        last = most
        for part in chosen.split(_CHUNK_POINTS // count):
            points = _disc(surfels[part], count).reshape(-1, 3)
            ids = class_ids[part].repeat_interleave(count)
            usable = grid.near(points)
            usable &= ~grid.valid(points, ids)
            yield grid.keys_of(points[usable]).unique()


def _disc(surfels: Surfels, count: int) -> Tensor:
    """Return [N, count, 3] world points that fill each disc evenly, in the spiral of a sunflower's seeds."""
    index = torch.arange(count, device=surfels.means.device) + 0.5
    radius, angle = RADIUS * (index / count).sqrt(), index * (torch.pi * (3.0 - 5.0**0.5))
    uv = radius * torch.stack([angle.cos(), angle.sin()])
    axes = rotation_from_quat(surfels.quats)[..., :2] * surfels.log_scales.exp()[:, None]  # [N, 3, 2]
    return surfels.means[:, None] + (axes[:, None] * uv.T[None, :, None]).sum(-1)


def _seen(grid: VisibilityGrid, views: Iterable[SeenSurface]) -> Tensor:
    """Return keys of the voxels in which a surface was seen, those too where classes collide."""
    found = grid.keys[:0]
    for view in views:
        surface = view.surface()
        found = torch.cat([found, grid.keys_of(lift(surface, view.camera)[surface > 0])]).unique()
    return found


def _passed(points: Tensor, view: SeenSurface, margin: float) -> Tensor:
    """Return [P] bool, whether the view's ray to the point goes on behind it."""
    camera, depth = view.camera, view.surface()
    xy, z = project(points, camera)
    column, row = xy.nan_to_num(nan=-1.0).clamp(-1.0, 1e9).floor().long().unbind(-1)
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    depth = depth.masked_fill(depth == 0, torch.inf)
    # The nearest of 3 x 3 pixels: on a slanted surface, depth changes within a pixel by more than a voxel.
    depth = -torch.nn.functional.max_pool2d(-depth[None, None], 3, stride=1, padding=1)[0, 0]
    depth = depth[row.clamp(0, camera.height - 1), column.clamp(0, camera.width - 1)]
    return inside & (z < (1.0 - TAU) * depth - margin)


def _innermost(grid: VisibilityGrid, points: Tensor) -> Tensor:
    """Return [P] int32, the object with the smallest convex hull around each point; 0 outside of all."""
    from scipy.spatial import ConvexHull, QhullError

    where = points.double().cpu()
    smallest = torch.full((len(where),), torch.inf, dtype=torch.float64)
    found = torch.zeros(len(where), dtype=torch.int32)
    for class_id in grid.classes.unique().tolist():
        if class_id == 0:
            continue
        own = grid.centres(grid.keys[grid.classes == class_id]).double().cpu().numpy()
        try:
            hull = ConvexHull(_without_strays(own[:: -(-len(own) // HULL_POINTS)], grid.voxel_size))
        except (QhullError, ValueError):  # few or flat voxels have no inside
            continue
        near = (where >= torch.from_numpy(hull.min_bound)).all(1) & (where <= torch.from_numpy(hull.max_bound)).all(1)
        near &= hull.volume < smallest
        inside = torch.nonzero(near)[:, 0]
        for *normal, offset in np.unique(hull.equations, axis=0).tolist():
            height = where[inside] @ torch.tensor(normal, dtype=torch.float64) + offset
            inside = inside[height <= -grid.voxel_size]  # the outermost layer is valid by the next one
        smallest[inside], found[inside] = hull.volume, class_id
    return found.to(points.device)


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
