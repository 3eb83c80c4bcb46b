"""Pixels of held-out views whose surface some training photo shows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU
from beags_plugin.core.surfels import Surfels
from beags_plugin.masks.reprojection import PixelMaps, landing
from beags_plugin.preparation.consistent_masks import render_depths
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings


def shown_pixels(
    surfels: Surfels,
    rasterizer: Rasterizer,
    settings: RasterSettings,
    held_out: Sequence[Camera],
    training: Sequence[Camera],
) -> list[Tensor]:
    """Return [H, W] bool for each held-out view: the pixels whose surface is visible in some training view.

    The surface is the median depth of the scene; a pixel without one is not shown. settings: with geometry.
    Every view is rendered once; one training view is held at a time.
    """
    depths = list(render_depths(surfels.detach(), held_out, rasterizer, settings, "median"))
    masks = [torch.zeros_like(depth, dtype=torch.bool) for depth in depths]
    maps = PixelMaps([*held_out, *training])
    surfaces = render_depths(surfels.detach(), training, rasterizer, settings, "median")
    for index, surface in enumerate(surfaces, start=len(held_out)):
        height, width = surface.shape
        for depth, mask, A, b in zip(depths, masks, *maps.towards(index), strict=False):
            rows, columns = torch.nonzero((depth > 0) & ~mask, as_tuple=True)
            far = depth[rows, columns]
            x, y = columns.to(far) + 0.5, rows.to(far) + 0.5
            lands, pixel, z = landing(x, y, far, (A, b), (width, height), far > 0)
            mask[rows[lands], columns[lands]] = (z - surface.reshape(-1)[pixel]).abs() <= TAU * z
    return masks
