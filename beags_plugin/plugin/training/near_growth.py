"""Which Gaussians close-ups show on objects: there a base grows by their pixels, elsewhere by those of whole photos."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE

MOST = 0.5
"""Share of the close-ups showing a Gaussian from which on it counts as near, if they show it on objects."""

MORE = 1.2
"""Bound of all Gaussians with close-ups, in units of that without: they take time."""


def shared_pixels(whole: int, of_objects: int) -> tuple[int, int]:
    """Return the pixels that bound the Gaussians near objects, and those that bound the others.

    whole: of all whole training photos. of_objects: those of objects in close-ups.
    """
    near = min(of_objects, round(MORE / 2 * whole))
    return near, min(round(MORE * whole) - near, whole)


class NearVotes:
    """Of N Gaussians, the number of close-ups that show them, and of those that show them on an object."""

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.shown = torch.zeros(count, device=device)
        self.inside = torch.zeros(count, device=device)

    def add(self, inside: Tensor, visible: Tensor) -> None:
        """Add a close-up. inside: [N] bool of ``on_objects``. visible: [N] bool."""
        self.shown += visible.to(self.shown)
        self.inside += (visible & inside).to(self.inside)

    def near(self) -> Tensor:
        """Return [N] bool, the Gaussians whose centre most close-ups show on an object."""
        return self.inside > MOST * self.shown

    def of(self, source: Tensor) -> NearVotes:
        """Return the votes of the Gaussians ``source`` [M]."""
        kept = NearVotes(0)
        kept.shown, kept.inside = self.shown[source], self.inside[source]
        return kept


def on_objects(means: Tensor, camera: Camera, labels: Tensor) -> Tensor:
    """Return [N] bool, the centres [N, 3] that the camera sees, or would see, in a pixel of an object.

    labels: [H, W] int32 of the camera's image.
    """
    local = means @ camera.rotation.T + camera.translation
    projected = local @ camera.K.T
    columns, rows = (projected[:, :2] / projected[:, 2:]).nan_to_num(-1.0, -1.0, -1.0).floor().long().unbind(dim=1)
    inside = (local[:, 2] > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    found = labels[rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)]
    return inside & (found != BACKGROUND) & (found != IGNORE)
