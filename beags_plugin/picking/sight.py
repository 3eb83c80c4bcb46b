"""How much the cameras see of each Gaussian, and from which of its two sides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.picking.dots import dots
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs

MOST_VIEWS = 64  # enough views to decide sides and visibility


def spread(cameras: Sequence[Camera]) -> Sequence[Camera]:
    """Return at most ``MOST_VIEWS`` of the cameras, evenly spread in their order."""
    return cameras[:: max(1, -(-len(cameras) // MOST_VIEWS))]


def seen_from(
    surfels: Surfels,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    settings: RasterSettings,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights [N] float64 of N Gaussians in the views, and their normals [N, 3] float64.

    A weight is the sum of w_i over the pixels of the views that ``spread`` chooses. A normal is a unit vector in the
    world, on the side from which most of that weight is seen. progress: receives (done, total) views.
    """
    inputs = geometry_inputs(surfels)
    settings = replace(settings, geometry=False, distortion=False)
    normals = torch.nan_to_num(rotation_from_quat(inputs.quats.double().cpu())[..., 2]).numpy()
    means = torch.nan_to_num(inputs.means.double().cpu(), posinf=0.0, neginf=0.0).numpy()
    weights, sides = np.zeros(len(surfels)), np.zeros(len(surfels))
    chosen = spread(cameras)
    for done, camera in enumerate(chosen, start=1):
        everywhere = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=inputs.means.device)
        with torch.no_grad():
            keys, values = rasterizer.sparse_class_contributions(inputs, camera, settings, everywhere, 1)
        index, weight = keys.cpu().numpy(), values.double().cpu().numpy()
        towards = camera.host.center.double().cpu().numpy() - means[index]
        cosine = dots(towards, normals[index]) / np.sqrt(dots(towards, towards)).clip(1e-12)
        weights[index] += weight
        sides[index] += weight * cosine
        if progress is not None:
            progress(done, len(chosen))
    return weights, normals * np.where(sides < 0, -1.0, 1.0)[:, None]
