"""Space that no view has seen is no evidence against a Gaussian (our extension of method, section 5).

In the paper a voxel supports a class only where a view has seen it: space inside things, under them and outside of all
views counts like space that was seen to be empty. Here a voxel in which no surface was seen, and through which no ray
has passed, supports the object whose convex hull it lies in, the smallest one; else the background. Hulls are a voxel
smaller, so that both sides of a contact keep their surfaces. What stands in a hollow object goes on where nobody could
look: unseen space in a mug or a basket supports the smaller objects too.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Protocol

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift, project
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.hulls import GAP, Hull, hulls_of
from beags_plugin.occupancy.sampling import RADIUS

TAU = 0.02  # of the depth: a ray has not passed what lies so little before its surface, as in reprojection (E5)
MARGIN = 1.5  # voxels, likewise
MOST_POINTS = 4096  # of a disc, to find the voxels that it reaches into
HOLLOW = 0.05  # of a hull that rays have passed through; in a hollow object others stand
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

    surfels: N Gaussians; class_ids: [N] int32, phi. views: the training views, read several times.
    """
    reached = torch.cat([*_reached(grid, surfels, class_ids), grid.keys[:0]]).unique()
    keys = reached[~torch.isin(reached, _seen(grid, views))]
    centres = grid.centres(keys)
    for view in views:
        passed = _passed(centres, view, MARGIN * grid.voxel_size)
        keys, centres = keys[~passed], centres[~passed]
    hulls = sorted(hulls_of(grid), key=lambda hull: (hull.volume, hull.class_id))
    owners = _innermost(hulls, centres, grid.voxel_size)
    found = [(grid.keys, grid.classes), (keys, owners), *_guests(hulls, keys, owners, views, grid.voxel_size)]
    together, classes = (torch.cat(parts) for parts in zip(*found, strict=True))
    together, order = together.sort(stable=True)
    return VisibilityGrid(grid.voxel_size, grid.origin, grid.num_classes, together, classes[order])


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


def _innermost(hulls: Sequence[Hull], points: Tensor, depth: float) -> Tensor:
    """Return [P] int32, the object of the first hull in which each point lies by ``depth``; 0 outside of all."""
    where = points.double().cpu()
    found = torch.zeros(len(where), dtype=torch.int32)
    for hull in hulls:
        free = torch.nonzero(found == 0)[:, 0]
        found[free[hull.within(where[free], depth)]] = hull.class_id  # the outermost layer is valid by the next one
    return found.to(points.device)


def _guests(
    hulls: Sequence[Hull], keys: Tensor, owners: Tensor, views: Iterable[SeenSurface], voxel_size: float
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield keys and classes of the unseen voxels in hollow objects, for the smaller objects that may stand in them."""
    smaller = [
        [guest for guest in hulls[:rank] if guest.meets(host, GAP * voxel_size)] for rank, host in enumerate(hulls)
    ]
    hosts = [rank for rank, guests in enumerate(smaller) if guests and bool((owners == hulls[rank].class_id).any())]
    for rank, share in zip(hosts, _empty_shares([hulls[rank] for rank in hosts], views, keys, voxel_size), strict=True):
        inside = keys[owners == hulls[rank].class_id]
        for guest in smaller[rank] if share > HOLLOW else ():
            yield inside, torch.full_like(inside, guest.class_id, dtype=torch.int32)


def _empty_shares(hulls: Sequence[Hull], views: Iterable[SeenSurface], like: Tensor, voxel_size: float) -> list[float]:
    """Return the share of each hull's inside that rays have passed; 0 if it has none."""
    lattices = [hull.lattice() for hull in hulls]
    inside = [points[hull.within(points, voxel_size)] for hull, points in zip(hulls, lattices, strict=True)]
    points = torch.cat([*inside, torch.zeros(0, 3)]).to(like.device, torch.float32)
    passed = torch.zeros(len(points), dtype=torch.bool, device=like.device)
    for view in views if hulls else ():
        passed |= _passed(points, view, MARGIN * voxel_size)
    parts = passed.split([len(points) for points in inside]) if inside else ()
    return [float(part.double().mean()) if len(part) else 0.0 for part in parts]
