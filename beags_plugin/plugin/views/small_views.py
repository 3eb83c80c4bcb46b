"""Training views at a fraction of their size: photos averaged over the area of each new pixel, with their cameras."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.plugin.views.dataset import resize_area

SizeAt = Callable[[int, int, int], tuple[int, int]]
"""From a step, and width and height of a whole photo, to the width and height that training sees, pixels."""
_FULL = 1.0 - 1e-4  # share of a small pixel from which all of it counts as covered: sums of float32 miss 1 by less


class SmallViews:
    """Small batches and cameras of training views, in steps that see small ones; else they are whole.

    They are made from whole ones when they are first asked for, and kept as long as the size of that view stays. keep:
    whether batches are kept; cameras always are.
    """

    def __init__(self, keep: bool) -> None:
        self._keep = keep
        self._size_at: SizeAt | None = None
        self._batches: dict[int, dict[str, Any]] = {}
        self._cameras: dict[int, Camera] = {}

    def shrink(self, size_at: SizeAt | None) -> None:
        """Give the sizes of ``size_at`` from here on; None: whole views."""
        self._size_at = size_at
        self._batches.clear()

    def camera(self, index: int, whole: Camera, step: int) -> Camera:
        """Return what ``step`` sees of the camera ``whole`` of a view, on the same device."""
        if (size := self._size(whole, step)) is None:
            return whole
        kept = self._cameras.get(index)
        if kept is None or (kept.width, kept.height) != size:
            kept = self._cameras[index] = small_camera(whole, size)
        return kept

    def batch(self, index: int, camera: Camera, whole: dict[str, Any], step: int) -> dict[str, Any]:
        """Return what ``step`` sees of a view's batch ``whole``, which ``BeagsDataManager`` describes.

        camera: of the whole view. Photos, and alpha, on black as they come, are averaged; labels take the id at each
        new pixel's centre. A small pixel is ``inside`` or ``known`` where all of it is.
        """
        if (size := self._size(camera, step)) is None:
            self._batches.clear()  # photos do not shrink again
            return whole
        kept = self._batches.get(index)
        if kept is None or kept["image"].shape[:2] != size[::-1]:
            kept = {name: _small(name, value, size) for name, value in whole.items()}
            if self._keep:
                self._batches[index] = kept
        return dict(kept)

    def once(self, camera: Camera, batch: dict[str, Any], step: int) -> tuple[Camera, dict[str, Any]]:
        """Return what ``step`` sees of another camera and its batch, of which nothing is kept."""
        if (size := self._size(camera, step)) is None:
            return camera, batch
        return small_camera(camera, size), {name: _small(name, value, size) for name, value in batch.items()}

    def _size(self, camera: Camera, step: int) -> tuple[int, int] | None:
        """Return width and height of what ``step`` sees of a view with this whole camera; None for all of it."""
        if self._size_at is None:
            return None
        size = self._size_at(step, camera.width, camera.height)
        return None if size == (camera.width, camera.height) else size


def small_camera(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return a camera whose image of ``size`` (width, height) covers that of ``camera`` from edge to edge.

    With pixel centres at + 0.5, x becomes x W' / W: focal length and principal point take that factor, each axis its
    own.
    """
    width, height = size
    host = camera.host
    factors = host.K.new_tensor([[width / host.width], [height / host.height], [1.0]])
    return Camera(host.viewmat, host.K * factors, width, height).to(camera.viewmat.device)


def _small(name: str, value: Any, size: tuple[int, int]) -> Any:
    if not isinstance(value, Tensor) or value.ndim < 2:
        return value
    width, height = size
    whole = value.cpu().numpy()
    if name == "labels":
        found = resize_nearest(whole, height, width)
    elif whole.dtype == np.bool_:
        found = resize_area(whole.astype(np.float32), width, height) >= _FULL
    else:
        found = resize_area(whole, width, height)
    return torch.from_numpy(np.ascontiguousarray(found)).to(value.device)
