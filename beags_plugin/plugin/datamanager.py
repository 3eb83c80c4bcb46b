"""Data manager: full images, with the class map of each view undistorted like its image."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from torch import Tensor

import beags_plugin.plugin.nerfstudio_patches  # noqa: F401  (checkpoints load again)
from beags_plugin.core.cameras import Camera
from beags_plugin.masks.label_maps import narrowed, widened
from beags_plugin.plugin.cameras import camera_from_nerfstudio
from beags_plugin.plugin.dataparser import BeagsDataParserConfig, absolute
from beags_plugin.plugin.dataset import BeagsDataset
from beags_plugin.plugin.undistortion import redistort_class_map, undistort_alpha, undistort_class_map
from beags_plugin.rasterizers.interface import IGNORE

OWN_KEYS = ("class_map", "alpha")


@dataclass
class BeagsDataManagerConfig(FullImageDatamanagerConfig):
    """Options of the data manager."""

    _target: type = field(default_factory=lambda: BeagsDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=BeagsDataParserConfig)

    def __setattr__(self, name: str, value: object) -> None:
        """Keep ``data`` absolute, so that a saved config.yml works from any folder."""
        super().__setattr__(name, absolute(value) if name == "data" else value)


@dataclass(frozen=True)
class View:
    """One undistorted view, on the data manager's device.

    It shares the data manager's memory; what is asked of it is computed anew: of all views at once, the images in float
    would take six times as much as their files, opened.

    name: the stem of the image file; where several share it, with the folders that tell them apart, joined by "_".
    pixels: [H, W, 3 or more], uint8 or float32 in 0..1. stored_labels: [H, W], as ``label_maps.narrowed`` gives them,
        or None. opacity: [H, W] uint8, or None.
    """

    camera: Camera
    name: str
    pixels: Tensor
    stored_labels: Tensor | None
    opacity: Tensor | None = None

    @property
    def image(self) -> Tensor:
        """[H, W, 3] float32 in 0..1, on black where it has alpha."""
        pixels = self.pixels[..., :3]
        return pixels.float() / 255.0 if pixels.dtype == torch.uint8 else pixels

    @property
    def labels(self) -> Tensor | None:
        """[H, W] int32 class ids or IGNORE; None if the view has no mask."""
        return None if self.stored_labels is None else widened(self.stored_labels)

    @property
    def alpha(self) -> Tensor | None:
        """[H, W] float32 in 0..1, the image's alpha; None if it is opaque."""
        return None if self.opacity is None else self.opacity.float() / 255.0

    def image_on(self, background: Tensor) -> Tensor:
        """The image [H, W, 3] with ``background`` [3] behind what is transparent."""
        alpha = self.alpha
        return self.image if alpha is None else self.image + (1.0 - alpha)[..., None] * background


class BeagsDataManager(FullImageDatamanager[BeagsDataset]):
    """nerfstudio's data manager of full images, for CPUs too, with class maps in every batch.

    Batches hold ``image`` [H, W, 3], ``class_map`` [H, W] int32 and ``alpha`` [H, W] uint8 where the image has it, all
    on the device; a training camera's metadata holds its ``class_map`` too. The cache holds class maps in the narrowest
    type. Training views come in a random order without repetition within a round, given by
    ``train_cameras_sampling_seed`` alone.
    """

    config: BeagsDataManagerConfig
    train_dataset: BeagsDataset
    eval_dataset: BeagsDataset

    def __init__(self, config: BeagsDataManagerConfig, *args, **kwargs) -> None:
        super().__init__(config, *args, **kwargs)
        self._distorted: dict[str, Cameras] = {}
        self._replaced = False  # whether the training class maps are no longer those of the files
        self._originals: list[Tensor] | None = None  # those of the files, where they are kept beside the ones in use
        # nerfstudio draws evaluation views from Python's global generator, which others use too.
        self._eval_order = random.Random(config.train_cameras_sampling_seed)

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]) -> list[dict]:
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        # nerfstudio overwrites intrinsics and sizes while it undistorts
        distorted = self._distorted[split] = deepcopy(dataset.cameras)
        # "cpu" pins memory, which needs CUDA; "gpu" means self.device, whatever that is.
        on_cpu = torch.device(self.device).type == "cpu"
        cache = super()._load_images(split, cache_images_device="gpu" if on_cpu else cache_images_device)
        for index, data in enumerate(cache):
            lens = (distorted, dataset.cameras, index)
            class_map = undistort_class_map(data["class_map"].numpy(), *lens)
            if class_map.shape != tuple(data["image"].shape[:2]):
                raise RuntimeError(f"class map {class_map.shape} and image {data['image'].shape} differ in size")
            data["class_map"] = narrowed(torch.from_numpy(class_map.astype(np.int32)))
            if (alpha := dataset.get_alpha(index)) is not None:
                data["alpha"] = torch.from_numpy(undistort_alpha(alpha, *lens))
            if on_cpu or cache_images_device == "gpu":
                data.update({key: data[key].to(self.device) for key in OWN_KEYS if key in data})
        return cache

    def undistort_eval_map(self, class_map: np.ndarray, index: int) -> np.ndarray:
        """A class map [h, w] of an evaluation view, of any size, as it would be had the camera no lens distortion."""
        assert self.cached_eval is not None  # the cameras are straightened when the images load
        return undistort_class_map(class_map, self._distorted["eval"], self.eval_dataset.cameras, index)

    def straight_train_map(self, class_map: np.ndarray, index: int) -> np.ndarray:
        """A class map [h, w] of a training view's file without its lens distortion."""
        assert self.cached_train is not None  # the cameras are straightened when the images load
        return undistort_class_map(class_map, self._distorted["train"], self.train_dataset.cameras, index)

    def as_in_file(self, class_map: np.ndarray, index: int) -> np.ndarray:
        """A class map [h', w'] of a training view with the lens distortion of its file, at the size it was read at."""
        assert self.cached_train is not None  # the cameras are straightened when the images load
        width, height = self.train_dataset.file_sizes[index]
        lens = (self._distorted["train"], self.train_dataset.cameras, index)
        return redistort_class_map(class_map, *lens, (height, width))

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        camera, data = super().next_train(step)
        data = self._on_device(data)
        # the boundary is computed inside the rasterizer, which sees the camera only: the mask travels with it
        camera.metadata = {**(camera.metadata or {}), "class_map": data["class_map"]}
        return camera, data

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        index = self.eval_unseen_cameras.pop(self._eval_order.randrange(len(self.eval_unseen_cameras)))
        if not self.eval_unseen_cameras:
            self.eval_unseen_cameras = list(range(len(self.eval_dataset)))
        data = self.cached_eval[index].copy()  # before the camera: loading undistorts the cameras
        data["image"] = data["image"].to(self.device)
        return self.eval_dataset.cameras[index : index + 1].to(self.device), self._on_device(data)

    @property
    def fixed_indices_eval_dataloader(self) -> list[tuple[Cameras, dict]]:
        """All evaluation views in order, as nerfstudio's evaluation reads them."""
        return [(camera, self._on_device(data)) for camera, data in super().fixed_indices_eval_dataloader]

    def views(self, split: Literal["train", "val", "test", "eval"], original: bool = False) -> list[View]:
        """All views of the training or (any other name) the evaluation split, in name order.

        original: give the labels of the mask files also after ``replace_class_maps``, if it kept them.
        """
        if split not in ("train", "val", "test", "eval"):
            raise ValueError(f"unknown split {split!r}")
        cache = self.cached_train if split == "train" else self.cached_eval
        dataset = self.train_dataset if split == "train" else self.eval_dataset
        names = unique_names(dataset.image_filenames)
        return [
            self._view(dataset, data, index, name, original)
            for index, (data, name) in enumerate(zip(cache, names, strict=True))
        ]

    def replace_class_maps(self, class_maps: Sequence[Tensor], keep: bool = True) -> None:
        """Train on ``class_maps``, one [H, W] integer tensor per training view, instead of the mask files.

        keep: whether ``views`` may be asked for the labels of the files later on.
        Raises ``ValueError`` if their number, a size or an id (0..IGNORE) is wrong.
        """
        if len(class_maps) != len(self.cached_train):
            raise ValueError(f"{len(class_maps)} class maps for {len(self.cached_train)} training views")
        for data, labels in zip(self.cached_train, class_maps, strict=True):
            if labels.shape != data["class_map"].shape:
                raise ValueError(f"class map {tuple(labels.shape)} for a view of {tuple(data['class_map'].shape)}")
            if labels.numel() and not 0 <= int(labels.min()) <= int(labels.max()) <= IGNORE:
                raise ValueError(f"class ids must lie in 0..{IGNORE}")
        if not self._replaced:
            self._originals = [data["class_map"] for data in self.cached_train]
        self._originals = self._originals if keep else None
        for data, labels in zip(self.cached_train, class_maps, strict=True):
            data["class_map"] = narrowed(labels.detach().int()).to(data["class_map"].device)
        self._replaced = True

    def _view(self, dataset: BeagsDataset, data: dict, index: int, name: str, original: bool) -> View:
        labels, stored = None, data["class_map"]
        replaced = self._replaced and dataset is self.train_dataset
        if replaced and original:
            if self._originals is None:
                raise ValueError("the labels of the mask files were not kept")
            replaced, stored = False, self._originals[index]
        if replaced or dataset.metadata["class_map_filenames"][index] is not None:
            labels = stored.to(self.device)
        camera = camera_from_nerfstudio(dataset.cameras, index).to(self.device)
        alpha = data["alpha"].to(self.device) if "alpha" in data else None
        return View(camera, name, data["image"].to(self.device), labels, alpha)

    def _on_device(self, data: dict) -> dict:
        """The view's data for use: class map and alpha on the device, the class map as int32."""
        moved = {key: value.to(self.device) if key in OWN_KEYS else value for key, value in data.items()}
        return {**moved, "class_map": widened(moved["class_map"])}


def unique_names(files: Sequence[Path]) -> list[str]:
    """For each file its stem; stems that several share get their folders before them, and a number if need be."""
    parts = [Path(file).with_suffix("").parts for file in files]
    depth = 1
    while len({path[-depth:] for path in parts}) < len(set(parts)):
        depth += 1
    stems = Counter(path[-1] for path in parts)
    taken = {stem for stem, uses in stems.items() if uses == 1}
    names = []
    for path in parts:
        name = path[-1]
        if stems[name] > 1:
            whole = "_".join(path[-depth:])
            name = next(n for n in chain([whole], (f"{whole}_{i}" for i in count(2))) if n not in taken)
            taken.add(name)
        names.append(name)
    return names
