"""Leave out the bands of the spherical harmonics that the training views do not need (our extension of the method)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.sh_resolution import with_degree
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs


def changes_of_fewer_bands(
    surfels: Surfels,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    progress: Callable[[int, int], None] | None = None,
) -> list[tuple[Surfels, float]]:
    """For each degree below the scene's: the scene with no more bands, and by how much it changes the views.

    surfels: N surfels. The change is the root mean square over all pixels of all ``cameras``, of colours in 0..1.
    """
    settings = replace(settings, geometry=False, distortion=False)
    candidates = [with_degree(surfels, cameras, degree) for degree in range(surfels.sh_degree)]
    squares, values = [0.0] * len(candidates), 0
    black = surfels.means.new_zeros(3)
    for index, camera in enumerate(cameras):
        with torch.no_grad():
            whole, *fewer = (
                rasterizer.rasterize(surfel_inputs(scene, camera), camera, settings, black).color
                for scene in (surfels, *candidates)
            )
        values += whole.numel()
        for degree, color in enumerate(fewer):
            squares[degree] += float((color - whole).double().square().sum())
        if progress:
            progress(index + 1, len(cameras))
    return [(scene, (sum_ / values) ** 0.5) for scene, sum_ in zip(candidates, squares, strict=True)]


def without_unneeded_bands(
    surfels: Surfels,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    tolerance: float,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Surfels, float]:
    """The scene with the fewest bands that change the views by at most ``tolerance``, and the change; 0.0 if all stay.

    What is kept imitates what is left out: see ``core.sh_resolution.with_degree``.
    """
    for scene, change in changes_of_fewer_bands(surfels, cameras, rasterizer, settings, progress):
        if change <= tolerance:
            return scene, change
    return surfels, 0.0
