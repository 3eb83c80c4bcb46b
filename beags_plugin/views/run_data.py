"""The data of a finished run: its views, each of whose photos and masks is read when first used."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
import torch
from torch import Tensor

from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.data_options import RunViewOptions
from beags_plugin.views.photo_files import PhotoFiles
from beags_plugin.views.scene_data import SceneData
from beags_plugin.views.split_photos import RunPhotos
from beags_plugin.views.views import View, unique_names

Split = Literal["train", "eval"]


class BothSplits(Protocol):
    """The training and the held-out views of a scene: ``RunData``, or the data manager of a training."""

    @property
    def train_dataset(self) -> Any: ...

    @property
    def eval_dataset(self) -> Any: ...

    @property
    def files(self) -> Mapping[Split, PhotoFiles]: ...

    def views(self, split: Literal["train", "val", "test", "eval"]) -> list[View]:
        """Return all views of the training or (any other name) the held-out split, in name order."""
        ...


class RunData:
    """The training and held-out views of a run, as its data manager gave them, on the CPU.

    held_out: the split "eval", which is val or test. scene: of the options, if it is already open. Photos stay in
    memory unless ``config`` streams them. Raises ``UserError`` for data that cannot be read.
    """

    def __init__(
        self, config: RunViewOptions, held_out: Literal["val", "test"], scene: SceneData | None = None
    ) -> None:
        self.config = config
        scene = scene or SceneData(config.dataparser)
        self.train_dataset = RunPhotos(scene.split("train"), config.camera_res_scale_factor)
        self.eval_dataset = RunPhotos(scene.split(held_out), config.camera_res_scale_factor)
        self.files: dict[Split, PhotoFiles] = {
            "train": PhotoFiles(self.train_dataset), "eval": PhotoFiles(self.eval_dataset)
        }  # fmt: skip
        self._photos: dict[tuple[Split, int], dict[str, Tensor]] = {}

    def views(self, split: Literal["train", "val", "test", "eval"]) -> list[View]:
        """Return all views of the training or (any other name) the held-out split, in name order."""
        whose: Split = "train" if split == "train" else "eval"
        files = self.files[whose]

        def view(index: int, name: str) -> View:
            camera = camera_from_nerfstudio(files.cameras, index)
            return View(camera, name, partial(self._photo, whose, index), partial(self._labels, whose, index))

        return [view(index, name) for index, name in enumerate(unique_names(files.dataset.image_filenames))]

    def _photo(self, split: Split, index: int) -> dict[str, Tensor]:
        if (split, index) in self._photos:
            return self._photos[split, index]
        files = self.files[split]
        photo: dict[str, Any] = files.photo(index, self.config.cache_images_type)
        bytes_of_pixel = photo["image"].shape[2] * photo["image"].element_size()
        gb = sum(width * height for width, height in files.dataset.file_sizes) * bytes_of_pixel / 1e9
        if not self.config.streams(gb):
            self._photos[split, index] = photo
        return photo

    def _labels(self, split: Split, index: int) -> Tensor | None:
        mask = self.files[split].mask_labels(index)
        return None if mask is None else torch.from_numpy(mask.astype(np.int32))
