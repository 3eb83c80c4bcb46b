"""Growth near objects: close-ups' pixels bound the Gaussians there, and whole photos' pixels those elsewhere."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.views.views import View

MOST = 0.85
"""A Gaussian is near if more than this share of the photos that show its place show an object there. What stands behind
an object is also on it in half of the photos, and in nearly all close-ups, hidden or not."""
PHOTOS = 48
"""Most photos that are asked."""

MORE = 1.2
"""Bound of all Gaussians with close-ups, in units of the bound without; more would take too long."""


def shared_pixels(whole: int, of_objects: int) -> tuple[int, int]:
    """Return the pixels that bound the Gaussians near objects, and those that bound the others.

    whole: of all whole training photos. of_objects: those of objects in close-ups.
    """
    near = min(of_objects, round(MORE / 2 * whole))
    return near, min(round(MORE * whole) - near, whole)


class MaskedPhotos:
    """Training photos with objects, at most ``PHOTOS`` from all over the path, which say what is near objects.

    photos: camera and labels [H, W] int32 of each photo that shows an object.
    """

    def __init__(self, photos: Sequence[tuple[Camera, Tensor]]) -> None:
        self.photos = photos

    @classmethod
    def of(cls, views: Sequence[View], with_objects: Sequence[int]) -> MaskedPhotos:
        """Choose among the views; with_objects: indices of those that show an object, ascending."""
        count = min(len(with_objects), PHOTOS)
        chosen = [views[with_objects[index * len(with_objects) // count]] for index in range(count)]
        photos = ((view.camera, view.labels) for view in chosen)
        return cls([(camera, labels) for camera, labels in photos if labels is not None])

    def near(self, means: Tensor) -> Tensor:
        """Return [N] bool, the centres [N, 3] that nearly all photos show on an object, hidden or not."""
        shown, inside = (torch.zeros(len(means), device=means.device) for _ in range(2))
        for camera, labels in self.photos:
            ids = _ids_at(means, camera, labels)
            shown += ids != IGNORE
            inside += _of_object(ids)
        return inside > MOST * shown


def on_objects(means: Tensor, camera: Camera, labels: Tensor) -> Tensor:
    """Return [N] bool, the centres [N, 3] that project into a pixel of an object, hidden or not.

    labels: [H, W] int32 of the camera's image.
    """
    return _of_object(_ids_at(means, camera, labels))


def _of_object(ids: Tensor) -> Tensor:
    return (ids != BACKGROUND) & (ids != IGNORE)


def _ids_at(means: Tensor, camera: Camera, labels: Tensor) -> Tensor:
    """Return the labels [N] of the pixels into which centres project; IGNORE outside the image."""
    local = means @ camera.rotation.T + camera.translation
    projected = local @ camera.K.T
    columns, rows = (projected[:, :2] / projected[:, 2:]).nan_to_num(-1.0, -1.0, -1.0).floor().long().unbind(dim=1)
    inside = (local[:, 2] > 0) & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    ids = labels[rows.clamp(0, camera.height - 1), columns.clamp(0, camera.width - 1)]
    return torch.where(inside, ids, IGNORE)
