"""Colours of an object for viewers whose colours do not change with the view, and an initial view of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from beags_plugin.core.sh import SH_C0
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.surfaces.close_up import close_up
from beags_plugin.surfaces.frames import bounding_box
from beags_plugin.surfaces.item import Viewpoints

_PIXELS = 256  # longer side of the images that weigh the views


@dataclass(frozen=True)
class SeenColors:
    """Gaussians of degree 0, and a view of them.

    surfels: N, each with its colour in the training views. eye: [3] the position of the training camera that shows most
    of them. up: [3] the mean of the training cameras' upward directions, unit length.
    """

    surfels: Surfels
    eye: np.ndarray
    up: np.ndarray


def seen_colors(surfels: Surfels, views: Viewpoints, on_render: Callable[[int], None]) -> SeenColors:
    """Return each Gaussian's mean colour in the training views, weighted by its contributions to their close-ups.

    The degree-0 coefficient alone is the mean over all directions, most of which no photo shows. A Gaussian that no
    view shows keeps it. surfels: N of one object. on_render: receives the number of views rendered.
    """
    surfels = surfels.detach()
    low, high = bounding_box(surfels)
    total, weights = torch.zeros_like(surfels.means), torch.zeros(len(surfels), 1).to(surfels.means)
    eye, most, up = np.zeros(3), -1.0, np.zeros(3)
    for done, camera in enumerate(views.cameras, 1):
        near = close_up(camera, low, high, views.settings.near, _PIXELS)
        inputs = surfel_inputs(surfels, near)
        everywhere = torch.zeros(near.height, near.width, dtype=torch.int32)
        with torch.no_grad():
            contributions = views.rasterizer.class_contributions(inputs, near, views.settings, everywhere, 1)
        total += contributions * inputs.colors
        weights += contributions
        rotation, shift = camera.viewmat[:3, :3].double(), camera.viewmat[:3, 3].double()
        up -= rotation[1].cpu().numpy()  # y points down.
        if (covered := float(contributions.sum())) > most:
            eye, most = (-rotation.T @ shift).cpu().numpy(), covered
        on_render(done)
    colors = torch.where(weights > 0, total / weights.clamp_min(1e-12), 0.5 + SH_C0 * surfels.sh_dc)
    fixed = replace(surfels, sh_dc=(colors - 0.5) / SH_C0, sh_rest=surfels.sh_rest[:, :0])
    length = float(np.linalg.norm(up))
    return SeenColors(fixed, eye, up / length if length > 1e-6 else np.array([0.0, 0.0, 1.0]))
