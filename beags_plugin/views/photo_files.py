"""The files of one split's views, without lens distortion, at the size of the training and at their own."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any, Literal

import cv2
import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.data.files import image_size
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.label_maps import to_compact
from beags_plugin.views import lens
from beags_plugin.views.cameras import camera_from_nerfstudio, small_camera
from beags_plugin.views.split_photos import SplitPhotos

Box = tuple[int, int, int, int]
"""Left, top, right and bottom of a region, pixels of a whole photo at its file's size, without lens; right and bottom
are excluded."""


class PhotoFiles:
    """Photos and masks of the views of a dataset, whose cameras are straightened in place.

    cameras: the straightened ones, to which all returned pictures belong.
    """

    def __init__(self, dataset: SplitPhotos) -> None:
        self.dataset = dataset
        self._distorted = deepcopy(dataset.cameras)
        lens.straighten(dataset.cameras)
        self.cameras = dataset.cameras

    def load(self, index: int, image_type: Literal["uint8", "float32"]) -> dict[str, Any]:
        """Read image, labels and alpha of a view from its files at the size of the training."""
        data = self.photo(index, image_type)
        labels = self.undistorted(self.dataset.get_labels(index, *self.dataset.file_sizes[index]), index)
        assert labels.shape == data["image"].shape[:2], "labels and image differ in size"
        return {"image_idx": index, **data, "labels": to_compact(torch.from_numpy(labels.astype(np.int32)))}

    def photo(self, index: int, image_type: Literal["uint8", "float32"]) -> dict[str, Any]:
        """Read ``image`` and, if there is any, ``alpha`` of a view, as ``load`` does."""
        image = self.dataset.get_numpy_image(index)
        if image_type == "float32":
            image = image.astype(np.float32) / np.float32(255.0)
        if lens.has_lens(self._distorted, index):
            image = lens.undistort_image(image, self._distorted, index)
        data = {"image": torch.from_numpy(image)}
        if (alpha := self.dataset.get_alpha(index)) is not None:
            straight = lens.undistort_alpha(alpha, self._distorted, self.cameras, index)
            data["alpha"] = torch.from_numpy(straight)
        return data

    def mask_labels(self, index: int) -> np.ndarray | None:
        """Read the labels [H, W] uint16 in the mask file of a view; None without a file."""
        if self.dataset.metadata["mask_filenames"][index] is None:
            return None
        return self.undistorted(self.dataset.get_labels(index, *self.dataset.file_sizes[index]), index)

    def undistorted(self, labels: np.ndarray, index: int) -> np.ndarray:
        """Remove a view's lens distortion from labels [h, w] of any size."""
        return lens.undistort_labels(labels, self._distorted, self.cameras, index)

    def straightened(self, places: np.ndarray, index: int) -> tuple[Camera, np.ndarray]:
        """Return a view's camera without lens, and the pixels of places of its photo in it, [P, 2] float64.

        places: [P, 2] float64, shares of the photo's width and height. Pixel centres are at + 0.5.
        """
        distorted = self._distorted
        points = places * [int(distorted.width[index]), int(distorted.height[index])]
        straight = lens.straight_points(points, distorted, self.cameras, index)
        return camera_from_nerfstudio(self.cameras, index), straight

    def as_in_file(self, labels: np.ndarray, index: int, border: int = IGNORE) -> np.ndarray:
        """Restore the lens distortion of a view's file in labels [h', w'], at the size at which the file was read.

        border: value outside the straight view.
        """
        width, height = self.dataset.file_sizes[index]
        return lens.redistort_labels(labels, self._distorted, self.cameras, index, (height, width), border)

    # -- at the size of the files ------------------------------------------------------------------------------------

    def full_camera(self, index: int) -> Camera:
        """Return a view's camera at the size of its photo's file, on the CPU."""
        camera = camera_from_nerfstudio(self.cameras, index)
        width, height = image_size(self.dataset.image_filenames[index])
        size = lens.straight_size(self._distorted, self.cameras, index, (height, width))
        return small_camera(camera, size)

    def full_regions(self, index: int, boxes: Sequence[Box]) -> list[dict[str, Tensor]]:
        """Read regions of a view at the size of its file: ``image`` [h, w, 3] uint8 and, if there is any, ``alpha``.

        The photo is decoded once and not stored. boxes: within ``full_camera``.
        """
        image, alpha = self.dataset.get_full_image(index)
        regions = []
        for box in boxes:
            region = {"image": self._region(image, index, box, cv2.INTER_LINEAR)}
            if alpha is not None:
                region["alpha"] = self._region(alpha, index, box, cv2.INTER_LINEAR)
            regions.append({name: torch.from_numpy(values) for name, values in region.items()})
        return regions

    def mask_regions(self, index: int, boxes: Sequence[Box]) -> list[np.ndarray] | None:
        """Read regions of a view's mask [h, w] uint16, at the size of those of its photo; None without a mask.

        If the mask's file is smaller than the photo's, the regions are as coarse as that file.
        """
        if self.dataset.metadata["mask_filenames"][index] is None:
            return None
        width, height = image_size(self.dataset.image_filenames[index])
        labels = self.dataset.get_labels(index, width, height)
        return [self._region(labels, index, box, cv2.INTER_NEAREST) for box in boxes]

    def _region(self, values: np.ndarray, index: int, box: Box, interpolation: int) -> np.ndarray:
        border = IGNORE if values.dtype == np.uint16 else 0
        return lens.undistort_region(values, self._distorted, self.cameras, index, box, interpolation, border)
