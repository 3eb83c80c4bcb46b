"""Picking of the Gaussian under the cursor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.plugin.viewer.viewing import NO_CLASSES, Viewing
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError

_FOCAL = 1000.0  # Focal length of the one rendered pixel: about that of a full-screen view, so that it is as sharp.


def camera_along(origin: Sequence[float], direction: Sequence[float], pixels: int = 1, focal: float = _FOCAL) -> Camera:
    """Return a view of few pixels that looks from ``origin`` along ``direction`` (world; of any length but 0).

    pixels: on each side. focal: their focal length.
    """
    position, along = (torch.tensor([float(x) for x in point], dtype=torch.float64) for point in (origin, direction))
    forward = along / along.norm()
    aside = torch.zeros(3, dtype=torch.float64)
    aside[int(forward.abs().argmin())] = 1.0  # The axis that is most nearly at right angles to the view.
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
    """Return the index of the Gaussian with the largest w_i along a ray; None if there is none. Renders one pixel.

    surfels: N Gaussians, as they are rendered. origin, direction: [3], world.
    """
    camera = camera_along(origin, direction).to(surfels.means.device)
    index = int(rasterizer.dominant_gaussian(geometry_inputs(surfels), camera, settings)[0, 0])
    return None if index < 0 else index


@dataclass(frozen=True)
class UnderCursor:
    """A Gaussian under the cursor.

    index: in the scene. class_id: None before the scene has classes. margin: of its assignment to that class.
    """

    index: int
    class_id: int | None
    margin: float

    def sentence(self, label: str | None) -> str:
        """Return the panel's text on it; label: of its class, None without a name."""
        if self.class_id is None:
            return f"Gaussian {self.index}; {NO_CLASSES}"
        if label is None:
            return f"Gaussian {self.index} of class {self.class_id}, which has no name."
        what = "background: nothing chosen" if self.class_id == BACKGROUND else f"Picked: {label}"
        return f"{what} (Gaussian {self.index}, {self.margin:.0%} of its weight)."


def under_cursor(viewing: Viewing, origin: Sequence[float], direction: Sequence[float]) -> UnderCursor:
    """Return the Gaussian that a viewer shows along a ray; raises ``UserError`` if none is there or it is busy."""
    model = viewing.model
    with viewing.held_soon():
        scene = viewing.visible()
        rank = pick(model.rasterizer, scene.surfels, model.settings(), origin, direction)
        if rank is None:
            raise UserError("nothing is shown there.")
        index = rank if scene.index is None else int(scene.index[rank])
        class_id = int(scene.class_ids[rank]) if bool(model.assigned) else None
        return UnderCursor(index, class_id, float(model.class_margin[index]))
