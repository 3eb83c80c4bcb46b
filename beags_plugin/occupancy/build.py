"""Build the visibility voxel grids from the training views (method, section 5; paper 3.4)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.voxel_size import reference_indices, voxel_size_of_reference
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, render_class_map, surface_depth
from beags_plugin.system.errors import UserError
from beags_plugin.system.filed_tensors import filed
from beags_plugin.system.progress import each_view

MIN_ALPHA_LIFTED = 0.5  # pixels with less alpha are not lifted


@dataclass(frozen=True)
class _View:
    """The P solid pixels of a view: solid [H, W] bool; row by row, their depth [P] float and class_id [P]."""

    camera: Camera
    solid: Tensor
    depth: Tensor
    class_id: Tensor

    def surface(self) -> Tensor:
        """Return [H, W], the depth of the solid pixels; 0 elsewhere."""
        return self.depth.new_zeros(self.solid.shape).masked_scatter_(self.solid, self.depth)

    def points(self) -> Tensor:
        """Return the lifted pixels, [P, 3] world."""
        return lift(self.surface(), self.camera)[self.solid]


class _Views:
    """All views on disk; each iteration reads them one by one."""

    def __init__(self, views: Iterable[_View], cameras: Sequence[Camera], device: torch.device) -> None:
        self._cameras = cameras
        self.counts: list[int] = []  # points per view
        self._tensors = filed(self._flat(views), device)

    def _flat(self, views: Iterable[_View]) -> Iterator[Tensor]:
        for view in views:
            self.counts.append(len(view.depth))
            yield from (view.solid, view.depth, view.class_id)

    def __iter__(self) -> Iterator[_View]:
        for index, camera in enumerate(self._cameras):
            yield _View(camera, *self._tensors[3 * index : 3 * index + 3])


def build_visibility_grid(
    surfels: Surfels,
    class_ids: Tensor,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    num_classes: int,
    k: int = 2000,
    seed: int = 0,
    depth: str = "median",
    progress: Callable[[int, int], None] | None = None,
) -> VisibilityGrid:
    """Render depth and class of every view, lift the pixels with A >= 0.5, and voxelise them per class.

    surfels: N Gaussians. class_ids: [N] int32, phi, below ``num_classes``.
    k: sets the voxel size (E8); seed: selects the points that measure it. depth: the lifted depth (``surface_depth``).
    Solid pixels lie in a temporary file (6 bytes each for up to 256 class ids), read twice, view by view, so memory
    grows only with the voxels and with the points that measure their size.
    Raises ``UserError`` if no pixel of any view reaches an alpha of 0.5.
    """
    settings = replace(settings, geometry=True, distortion=False)

    def render(index: int) -> _View:
        return _render(surfels, class_ids, cameras[index], rasterizer, settings, num_classes, depth)

    views = _Views(each_view(len(cameras), render, progress), cameras, surfels.means.device)
    reference, total = _reference_cloud(views, k, seed)
    if total == 0:
        raise UserError("no training view shows anything solid (alpha >= 0.5): train the base for more steps.")
    size = voxel_size_of_reference(reference, total, k, seed)
    origin = torch.from_numpy(reference.min(0).astype(np.float64)).to(surfels.means.device)
    clouds = ((view.points(), view.class_id) for view in views)
    return VisibilityGrid.from_points(clouds, size, origin, num_classes)


def _render(surfels, class_ids, camera, rasterizer, settings, num_classes: int, depth: str) -> _View:
    with torch.no_grad():
        rendered = rasterizer.rasterize(geometry_inputs(surfels), camera, settings, surfels.means.new_zeros(3))
    classes, _ = render_class_map(rasterizer, surfels, class_ids, camera, settings)
    surface = surface_depth(rendered, depth)
    solid = (rendered.alpha >= MIN_ALPHA_LIFTED) & torch.isfinite(surface) & (surface > 0)
    small = torch.uint8 if num_classes <= 1 << 8 else torch.int16 if num_classes <= 1 << 15 else torch.int32
    return _View(camera, solid, surface[solid], classes[solid].to(small))


def _reference_cloud(views: _Views, k: int, seed: int) -> tuple[np.ndarray, int]:
    """Return the thinned cloud of all classes [R, 3] and the number of all points."""
    total = sum(views.counts)
    chosen = reference_indices(total, k, seed)
    pieces, first = [np.zeros((0, 3), dtype=np.float32)], 0
    for view in views:
        start, stop = np.searchsorted(chosen, [first, first + len(view.depth)])
        own = torch.from_numpy(chosen[start:stop] - first).to(view.depth.device)
        pieces.append(view.points()[own].cpu().numpy())
        first += len(view.depth)
    return np.concatenate(pieces), total
