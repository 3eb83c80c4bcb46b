"""Growth near objects: close-ups' pixels bound the Gaussians there, and whole photos' pixels those elsewhere."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE

MOST = 0.85
"""A Gaussian is near if more than this share of the whole photos that show it show it on an object. What stands behind
an object is also on it in half of the photos, and in nearly all close-ups, hidden or not."""

MORE = 1.2
"""Bound of all Gaussians with close-ups, in units of the bound without; more would take too long."""


def shared_pixels(whole: int, of_objects: int) -> tuple[int, int]:
    """Return the pixels that bound the Gaussians near objects, and those that bound the others.

    whole: of all whole training photos. of_objects: those of objects in close-ups.
    """
    near = min(of_objects, round(MORE / 2 * whole))
    return near, min(round(MORE * whole) - near, whole)


class NearVotes:
    """For each of N Gaussians, the number of whole photos that show it, and of those that show it on an object."""

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.shown = torch.zeros(count, device=device)
        self.inside = torch.zeros(count, device=device)

    def add(self, inside: Tensor, visible: Tensor) -> None:
        """Add a photo. inside: [N] bool of ``on_objects``. visible: [N] bool."""
        self.shown += visible.to(self.shown)
        self.inside += (visible & inside).to(self.inside)

    def near(self) -> Tensor:
        """Return [N] bool, the Gaussians whose centre nearly all photos show on an object."""
        return self.inside > MOST * self.shown

    def of(self, source: Tensor) -> NearVotes:
        """Return the votes of the Gaussians ``source`` [M]."""
        votes = NearVotes(0)
        votes.shown, votes.inside = self.shown[source], self.inside[source]
        return votes


def on_objects(means: Tensor, camera: Camera, labels: Tensor) -> Tensor:
    """Return [N] bool, the centres [N, 3] that project into a pixel of an object, hidden or not.

    labels: [H, W] int32 of the camera's image.
    """
    local = means @ camera.rotation.T + camera.translation
    projected = local @ camera.K.T
    columns, rows = (projected[:, :2] / projected[:, 2:]).nan_to_num(-1.0, -1.0, -1.0).floor().long().unbind(dim=1)
    inside = (local[:, 2] > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    ids = labels[rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)]
    return inside & (ids != BACKGROUND) & (ids != IGNORE)
