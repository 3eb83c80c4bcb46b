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
    """Small batches and cameras of training views.

    They are made from whole ones when they are first asked for, and kept as long as the size of that view stays. keep:
    whether batches are kept; cameras always are.
    """

    def __init__(self, keep: bool) -> None:
        self._keep = keep
        self._batches: dict[int, dict[str, Any]] = {}
        self._cameras: dict[int, Camera] = {}

    def batch(self, index: int, size: tuple[int, int], whole: dict[str, Any]) -> dict[str, Any]:
        """Return a view's batch at ``size`` (width, height): of ``whole``, which ``BeagsDataManager`` describes.

        Photos, and alpha, on black as they come, are averaged; labels take the id at each new pixel's centre. A small
        pixel is ``inside`` or ``known`` where all of it is.
        """
        kept = self._batches.get(index)
        if kept is not None and kept["image"].shape[:2] == size[::-1]:
            return dict(kept)
        small = {name: _small(name, value, size) for name, value in whole.items()}
        if self._keep:
            self._batches[index] = small
        return dict(small)

    def camera(self, index: int, size: tuple[int, int], whole: Camera) -> Camera:
        """Return the camera of ``whole`` at ``size`` (width, height), on the same device."""
        kept = self._cameras.get(index)
        if kept is None or (kept.width, kept.height) != size:
            kept = self._cameras[index] = small_camera(whole, size)
        return kept

    def clear(self) -> None:
        """Keep nothing: photos are whole from here on."""
        self._batches.clear()
        self._cameras.clear()


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
