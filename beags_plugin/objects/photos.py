"""Photos of an object of a run, cropped to it, for textures."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera, cropped
from beags_plugin.core.lifting import project
from beags_plugin.core.surfels import Surfels
from beags_plugin.objects.shown import ShownScene
from beags_plugin.surfaces.frames import Frame, bounding_box
from beags_plugin.surfaces.item import Photo
from beags_plugin.views.cameras import small_camera
from beags_plugin.views.close_ups import fitted
from beags_plugin.views.split_photos import resize_area

_AROUND = 0.1  # margin of a crop, over the object's box in space
_MARGIN = 8  # further margin in pixels
_KEPT = 200_000_000  # most bytes of an object's photos, masks and depths that stay in memory
_SHARPER = 1.25  # least side of a file's region, over that of the training, for which it is read

Box = tuple[int, int, int, int]
"""Left, top, right and bottom, pixels; right and bottom are excluded."""


class _Kept:
    """Tensors that are made when first used, and stay in memory while all take at most ``_KEPT`` bytes."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, int], Tensor] = {}
        self._bytes = 0

    def get(self, name: str, view: int, make: Callable[[], Tensor]) -> Tensor:
        if (found := self._values.get((name, view))) is not None:
            return found
        made = make()
        size = made.numel() * made.element_size()
        if self._bytes + size <= _KEPT:
            self._bytes += size
            self._values[name, view] = made = made.clone()  # a view would keep its whole picture in memory
        return made

    def drop(self, name: str) -> None:
        """Forget the tensors of one name, which are made again when they are used."""
        for key in [key for key in self._values if key[0] == name]:
            dropped = self._values.pop(key)
            self._bytes -= dropped.numel() * dropped.element_size()


def photos_of(shown: ShownScene, class_id: int | None, part: Surfels, frame: Frame) -> Sequence[Photo]:
    """Return the photos of a class (None: of all classes) in ``frame``; images, masks and depth are read when used.

    part: its Gaussians, in the run's frame. Photos are cropped to its box, and photos that do not show the box left
    out. A photo whose file has more pixels than the training used has a ``sharper`` one; all of these take at most
    ``_KEPT`` bytes.
    """
    kept, boxes = _Kept(), list[tuple[int, Box]]()
    low, high = bounding_box(part)
    reach = _AROUND * (high - low)
    corners = torch.cartesian_prod(*torch.stack([low - reach, high + reach], dim=1).double())
    for view, camera in enumerate(shown.views.cameras):
        box = _box(camera, corners) if class_id is not None else (0, 0, camera.width, camera.height)
        if box is not None:
            boxes.append((view, box))
    sharp, most = _Kept(), _KEPT / 3 / max(len(boxes), 1)
    return [
        _photo(shown, class_id, frame, view, box, kept, _sharper(shown, class_id, frame, view, box, kept, sharp, most))
        for view, box in boxes
    ]


def _photo(
    shown: ShownScene, class_id: int | None, frame: Frame, view: int, box: Box, kept: _Kept, sharper: Photo | None
) -> Photo:
    """Return a part of a photo at the size of the training."""
    left, top, right, bottom = box
    there = slice(top, bottom), slice(left, right)
    image = partial(kept.get, "image", view, partial(_image, shown, view, there))
    own = partial(kept.get, "own", view, partial(_own, shown, view, class_id, there))
    depth = partial(kept.get, "depth", view, partial(_depth, shown, view, frame.scale, there))
    camera = frame.camera(cropped(shown.views.cameras[view], left, top, right - left, bottom - top))
    return Photo(camera, image, own, depth, sharper=sharper)


def _sharper(
    shown: ShownScene, class_id: int | None, frame: Frame, view: int, box: Box, coarse: _Kept, kept: _Kept, most: float
) -> Photo | None:
    """Return a part of a photo with at most ``most`` pixels of its file; None if these are hardly more.

    coarse: what is kept of photos at the size of the training. Their images are dropped once this one is read.
    """
    if class_id is None:
        return None
    files, index = shown.manager.files["train"], shown.chosen[view]
    camera, full = shown.views.cameras[view], files.full_camera(index)
    across, down = full.width / camera.width, full.height / camera.height
    left, right = math.floor(box[0] * across), min(full.width, math.ceil(box[2] * across))
    top, bottom = math.floor(box[1] * down), min(full.height, math.ceil(box[3] * down))
    size = fitted(right - left, bottom - top, most)
    zoom = size[0] * across / (right - left)
    if zoom < _SHARPER:
        return None
    # Pixels of the photo at the size of the training, at the middle of each finer pixel.
    columns = (((torch.arange(size[0]) + 0.5) * (right - left) / size[0] + left) / across).long()
    rows = (((torch.arange(size[1]) + 0.5) * (bottom - top) / size[1] + top) / down).long()
    there = rows.clamp(max=camera.height - 1)[:, None], columns.clamp(max=camera.width - 1)[None]

    def read() -> Tensor:
        coarse.drop("image")
        region = files.full_regions(index, [(left, top, right, bottom)])[0]["image"]
        return torch.from_numpy(resize_area(region.numpy(), *size))

    def image() -> Tensor:
        colors = kept.get("image", view, read).float() / 255.0
        return colors if shown.exposures is None else shown.exposures.evened(colors, shown.names[view])

    def read_own() -> Tensor:
        labels = shown.views.labels[view].cpu() == class_id
        return torch.from_numpy(np.packbits(labels[there].numpy()))

    def own() -> Tensor:
        bits = kept.get("own", view, read_own).numpy()  # An eighth of the memory is worth the time to unpack it.
        mask = torch.from_numpy(np.unpackbits(bits, count=size[0] * size[1]).view(bool).reshape(size[1], size[0]))
        return mask if shown.exposures is None else mask & (kept.get("image", view, read) < 255).any(dim=2)

    of_file = small_camera(cropped(full, left, top, right - left, bottom - top), size)
    return Photo(frame.camera(of_file), image, own, partial(_depth, shown, view, frame.scale, there), math.ceil(zoom))


def _box(camera: Camera, corners: Tensor) -> Box | None:
    """Return the part of a view that shows a box of 8 corners [8, 3]; all of it from inside, None if none."""
    xy, z = project(corners, camera.to(torch.float64))
    if bool((z <= 0).all()):
        return None
    if bool((z <= 0).any()):
        return 0, 0, camera.width, camera.height
    (left, top), (right, bottom) = (xy.amin(dim=0) - _MARGIN).tolist(), (xy.amax(dim=0) + _MARGIN).tolist()
    left, top = max(0, math.floor(left)), max(0, math.floor(top))
    right, bottom = min(camera.width, math.ceil(right)), min(camera.height, math.ceil(bottom))
    return (left, top, right, bottom) if left < right and top < bottom else None


def _image(shown: ShownScene, view: int, there: tuple[slice, slice]) -> Tensor:
    """Return a part of a photo [H, W, 3] in the scene's exposure."""
    image = shown.photos[view].image.cpu()[there]
    return image if shown.exposures is None else shown.exposures.evened(image, shown.names[view])


def _own(shown: ShownScene, view: int, class_id: int | None, there: tuple[slice, slice]) -> Tensor:
    """Return the pixels [H, W] bool of a class, without overexposed ones, which the scene's exposure turns grey."""
    labels = shown.views.labels[view].cpu()[there]
    own = torch.ones_like(labels, dtype=torch.bool) if class_id is None else labels == class_id
    return own if shown.exposures is None else own & (shown.photos[view].image.cpu()[there] < 1.0).any(dim=2)


def _depth(shown: ShownScene, view: int, scale: float, there: tuple[Any, Any]) -> Tensor:
    return shown.views.depths[view].cpu()[there] / scale
