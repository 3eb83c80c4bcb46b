"""Picking of the Gaussian under the cursor."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs

_FOCAL = 1000.0  # of the one rendered pixel: about that of a full-screen view, so that it is as sharp


def camera_along(origin: Sequence[float], direction: Sequence[float], pixels: int = 1, focal: float = _FOCAL) -> Camera:
    """Return a view of few pixels that looks from ``origin`` along ``direction`` (world; of any length but 0).

    pixels: on each side. focal: their focal length.
    """
    position, along = (torch.tensor([float(x) for x in point], dtype=torch.float64) for point in (origin, direction))
    forward = along / along.norm()
    aside = torch.zeros(3, dtype=torch.float64)
    aside[int(forward.abs().argmin())] = 1.0  # the axis that is least along the view
    right = torch.linalg.cross(forward, aside)
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    K = torch.tensor([[focal, 0.0, pixels / 2], [0.0, focal, pixels / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, pixels, pixels)


@torch.no_grad()
def pick(
    rasterizer: Rasterizer,
    surfels: Surfels,
    settings: RasterSettings,
    origin: Sequence[float],
    direction: Sequence[float],
) -> int | None:
    """Return the index of the Gaussian with the largest w_i along a ray; None where nothing is. Renders one pixel.

    surfels: N Gaussians, as they are rendered. origin, direction: [3], world.
    """
    camera = camera_along(origin, direction).to(surfels.means.device)
    index = int(rasterizer.dominant_gaussian(geometry_inputs(surfels), camera, settings)[0, 0])
    return None if index < 0 else index
