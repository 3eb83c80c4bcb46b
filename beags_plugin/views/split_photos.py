"""Photos and labels of one split at the size of the cameras, lens distortion included."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from PIL import Image

from beags_plugin.labels.class_ids import IGNORE, resize_nearest
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.images import read_image
from beags_plugin.views.cameras import downscaled_size, resize_cameras
from beags_plugin.views.scene_data import SplitData

if TYPE_CHECKING:
    from beags_plugin.views.cameras import AnyCameras

AVERAGED = 4
"""Pixels, along each side, that a decoded photo has for each that is needed; a JPEG's decoder averages the others."""


class SplitPhotos:
    """Views of one split: photos, and labels [H, W] uint16, all IGNORE where a view has no mask.

    Images with alpha are put on black. Images are averaged over the area of each new pixel, labels take the id at its
    centre; both cover the camera's image from edge to edge. A subclass sets the attributes, then calls ``set_sizes``.
    """

    cameras: AnyCameras
    metadata: dict[str, Any]
    image_filenames: Sequence[Path]
    file_sizes: list[list[int]]

    def set_sizes(self, scale_factor: float) -> None:
        """Resize the cameras in place by a factor, and record the size at which files are read."""
        if scale_factor != 1.0:
            width, height = (
                downscaled_size(side, 1.0 / scale_factor) for side in (self.cameras.width, self.cameras.height)
            )
            resize_cameras(self.cameras, width, height)
        # Straightening crops the cameras, but not the files.
        self.file_sizes = torch.cat([self.cameras.width, self.cameras.height], 1).tolist()

    def __len__(self) -> int:
        return len(self.image_filenames)

    def get_numpy_image(self, image_idx: int) -> np.ndarray:
        """Read the image [H, W, 3] uint8, sRGB, before undistortion."""
        path, size = self.image_filenames[image_idx], self.file_sizes[image_idx]
        return resize_area(read_image(path, partial(_colors, path), enough=AVERAGED * max(size)), *size)

    def get_alpha(self, image_idx: int) -> np.ndarray | None:
        """Read the image's alpha [H, W] uint8, before undistortion; None if it is opaque everywhere."""
        alpha = read_image(self.image_filenames[image_idx], _alpha)
        return None if alpha is None else resize_area(alpha, *self.file_sizes[image_idx])

    def get_full_image(self, image_idx: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Read image and alpha at the size of the file, which is decoded once."""
        path = self.image_filenames[image_idx]
        return read_image(path, lambda image: (_colors(path, image), _alpha(image)))

    def get_metadata(self, data: dict) -> dict:
        """Read the labels of view ``data["image_idx"]``, before undistortion."""
        index = data["image_idx"]
        return {"labels": torch.from_numpy(self.get_labels(index, *self.file_sizes[index]))}

    def get_labels(self, image_idx: int, width: int, height: int) -> np.ndarray:
        """Read the labels [height, width] uint16 of a view, before undistortion."""
        path = self.metadata["mask_filenames"][image_idx]
        if path is None:
            return np.full((height, width), IGNORE, np.uint16)
        ids = read_id_mask(path, self.metadata["ignore_ids"])
        return resize_nearest(ids, height, width)


class RunPhotos(SplitPhotos):
    """The photos of a split of a finished run's data; scale_factor: on top of the parser's downscale factor."""

    def __init__(self, views: SplitData, scale_factor: float = 1.0) -> None:
        self.cameras, self.metadata, self.image_filenames = views.cameras, views.metadata, views.images
        self.set_sizes(scale_factor)


def _colors(path: Path, image: Image.Image) -> np.ndarray:
    if image.mode.startswith(("I", "F")):
        raise UserError(f"the image {path} has more than 8 bits per channel: convert it to 8 bits.")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        image = Image.alpha_composite(Image.new("RGBA", image.size, (0, 0, 0, 255)), image)
    return np.array(image.convert("RGB"))


def _alpha(image: Image.Image) -> np.ndarray | None:
    alpha = np.array(image.convert("RGBA").getchannel("A")) if image.has_transparency_data else None
    return None if alpha is None or (alpha == 255).all() else alpha


def resize_area(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Average an image [H, W, C] or [H, W] over the area of each of the ``width`` x ``height`` new pixels."""
    if image.shape[:2] == (height, width):
        return image
    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
