"""Close-ups of training photos: regions around objects, at up to the size of the files, as further views."""

from __future__ import annotations

import math
import random
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera, cropped
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE, resize_nearest
from beags_plugin.labels.label_maps import CompressedMap, to_int32
from beags_plugin.views.cameras import small_camera
from beags_plugin.views.photo_files import Box, PhotoFiles
from beags_plugin.views.split_photos import resize_area
from beags_plugin.views.views import View

CLOSE_UPS = "close-ups"  # A close-up's name is this folder, its photo's name, and a number.
DETAIL = 4.0
"""Pixels stored of all close-ups of a photo, over the pixels of a step."""
MOST_BYTES = 1e9
"""Most bytes of all close-ups; fewer pixels are stored to stay below it, but never fewer than a step sees."""
WINDOWS = 0.5
"""Share of the steps that see a window of a close-up larger than a step; the others see it scaled down."""


@dataclass
class CloseUp:
    """A region of a training photo, at the size at which it is stored.

    photo: index of the view. camera: of the region. image: [h, w, 3] uint8. alpha: [h, w] uint8 or None. labels: of the
    region, at any size.
    """

    photo: int
    camera: Camera
    image: np.ndarray
    alpha: np.ndarray | None
    labels: CompressedMap

    def seen(self, size: tuple[int, int], window: Box) -> tuple[Camera, dict[str, Any]]:
        """Return camera and batch of a window of the close-up, once that is scaled to ``size`` (width, height)."""
        left, top, right, bottom = window
        camera = cropped(small_camera(self.camera, size), left, top, right - left, bottom - top)

        def part(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values[top:bottom, left:right]))

        labels = part(resize_nearest(self.labels.unpacked().numpy(), *size[::-1]))
        batch = {
            "image_idx": self.photo,
            "close_up": True,
            "image": part(resize_area(self.image, *size)),
            "labels": labels,
        }
        if self.alpha is not None:
            batch["alpha"] = part(resize_area(self.alpha, *size))
        return camera, batch


class CloseUps:
    """The close-ups of all training photos, and which of them a step sees.

    names: of the photos. pixels: of a step. share: of the steps that see a close-up, if their photo has one. seed: it
    decides together with the step which close-up is seen. gain: magnification of objects over whole photos, in the
    mean.
    """

    def __init__(
        self, close_ups: Sequence[CloseUp], names: Sequence[str], pixels: int, share: float, seed: int, gain: float
    ) -> None:
        self.pixels, self.share, self.seed, self.gain = pixels, share, seed, gain
        self.close_ups: list[CloseUp] = []
        self._of_photo: dict[int, list[CloseUp]] = defaultdict(list)
        self._photos = names
        self.names: list[str] = []
        self.add(close_ups)

    def add(self, close_ups: Sequence[CloseUp]) -> None:
        """Add close-ups of photos."""
        self.close_ups += close_ups
        for each in close_ups:
            self._of_photo[each.photo].append(each)
            self.names.append(f"{CLOSE_UPS}/{self._photos[each.photo]}-{len(self._of_photo[each.photo])}")

    def blind(self) -> list[int]:
        """Return the photos without a close-up."""
        return [photo for photo in range(len(self._photos)) if photo not in self._of_photo]

    @property
    def kept(self) -> float:
        """Return the number of pixels stored of all close-ups of a photo."""
        return kept_pixels(self.pixels, len(self._photos))

    def drawn(self, photo: int, step: int) -> tuple[Camera, dict[str, Any]] | None:
        """Return camera and batch, on the CPU, of the close-up that a step sees; None if it sees the whole photo."""
        chance = random.Random(self.seed * 1_000_003 + step)
        own = self._of_photo.get(photo)
        if chance.random() >= self.share or not own:
            return None
        close_up = own[chance.randrange(len(own))]
        stored = close_up.camera.width, close_up.camera.height
        size = stored if chance.random() < WINDOWS else fitted(*stored, self.pixels)
        width, height = fitted(*size, self.pixels)
        left, top = chance.randint(0, size[0] - width), chance.randint(0, size[1] - height)
        return close_up.seen(size, (left, top, left + width, top + height))

    def views(self, device: torch.device | str) -> Iterator[View]:
        """Yield each close-up as a view, scaled down to a step's pixels, with the labels that training sees."""
        for close_up, name in zip(self.close_ups, self.names, strict=True):
            size = fitted(close_up.camera.width, close_up.camera.height, self.pixels)
            camera = small_camera(close_up.camera, size).to(device)
            yield View(camera, name, partial(_data, close_up, size, device), partial(_labels, close_up, size, device))

    def replace_labels(self, labels: Sequence[Tensor]) -> None:
        """Replace the labels that training sees. labels: of the sizes of ``views``."""
        for close_up, each in zip(self.close_ups, labels, strict=True):
            close_up.labels = CompressedMap(each.cpu())

    def object_pixels(self) -> int:
        """Return the number of pixels of objects, at the stored size."""
        total = 0.0
        for each in self.close_ups:
            labels = to_int32(each.labels.unpacked())
            share = ((labels != BACKGROUND) & (labels != IGNORE)).double().mean()
            total += float(share) * each.camera.width * each.camera.height
        return round(total)


def _data(close_up: CloseUp, size: tuple[int, int], device: torch.device | str) -> dict[str, Tensor]:
    _, batch = close_up.seen(size, (0, 0, *size))
    return {name: batch[name].to(device) for name in ("image", "alpha") if name in batch}


def _labels(close_up: CloseUp, size: tuple[int, int], device: torch.device | str) -> Tensor:
    _, batch = close_up.seen(size, (0, 0, *size))
    return to_int32(batch["labels"]).to(device)


def fitted(width: int, height: int, pixels: float) -> tuple[int, int]:
    """Return the size of the same proportions with at most about ``pixels`` pixels, never larger than given."""
    factor = min(1.0, math.sqrt(pixels / (width * height)))
    return max(1, round(width * factor)), max(1, round(height * factor))


def kept_pixels(pixels: int, photos: int) -> float:
    """Return the number of pixels stored of all close-ups of one of ``photos`` photos. pixels: of a step."""
    return pixels * max(min(DETAIL, MOST_BYTES / (3.0 * pixels * photos)), 1.0)


def kept_size(box: Box, boxes: int, kept: float) -> tuple[int, int]:
    """Return the stored width and height of a close-up, one of ``boxes`` of its photo. kept: ``kept_pixels``."""
    left, top, right, bottom = box
    return fitted(right - left, bottom - top, kept / boxes)


def read_close_ups(
    files: PhotoFiles, photo: int, boxes: Sequence[Box], kept: float, whole: np.ndarray | None = None
) -> list[CloseUp]:
    """Read the close-ups of a photo, which is decoded once.

    kept: ``kept_pixels``. whole: labels [H, W] of the whole photo at any size if it has no mask, else None.
    """
    camera = files.full_camera(photo)
    masks = files.mask_regions(photo, boxes) if whole is None else None
    if masks is None:
        assert whole is not None, "close-ups come from masks"
        sized = resize_nearest(whole, camera.height, camera.width)
        masks = [sized[top:bottom, left:right] for left, top, right, bottom in boxes]
    close_ups = []
    for number, (box, region) in enumerate(zip(boxes, files.full_regions(photo, boxes), strict=True)):
        size = kept_size(box, len(boxes), kept)
        left, top, right, bottom = box
        own = small_camera(cropped(camera, left, top, right - left, bottom - top), size)
        alpha = resize_area(region["alpha"].numpy(), *size) if "alpha" in region else None
        labels = CompressedMap(torch.from_numpy(resize_nearest(masks[number], size[1], size[0]).astype(np.int32)))
        close_ups.append(CloseUp(photo, own, resize_area(region["image"].numpy(), *size), alpha, labels))
    return close_ups
