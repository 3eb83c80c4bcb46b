"""Data manager: full images, with the class map of each view undistorted like its image."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import track
from torch import Tensor
from tyro.conf import Suppress

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.labels.label_maps import CompressedMap, to_compact, to_int32
from beags_plugin.plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig, absolute
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.plugin.views.streaming import Lazy, StreamedViews
from beags_plugin.plugin.views.undistortion import (
    has_lens,
    redistort_labels,
    straighten,
    undistort_alpha,
    undistort_image,
    undistort_labels,
)
from beags_plugin.plugin.views.views import View, unique_names
from beags_plugin.system import processes
from beags_plugin.system.errors import UserError

READ_AHEAD = 8  # streamed images that are read before their use
OWN_KEYS = ("labels", "alpha")


@dataclass
class BeagsDataManagerConfig(FullImageDatamanagerConfig):
    """Options of the data manager."""

    _target: type = field(default_factory=lambda: BeagsDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=BeagsDataParserConfig)
    stream: Literal["auto", "always", "never"] = "auto"
    """Whether images are read from disk when they are needed instead of being kept in memory; auto: if the images of a
    split would take more than stream_above_gb. Training gives the same, bit for bit."""
    stream_above_gb: Suppress[float] = 0.5
    """GB (10^9 bytes) that the images of a split may take in memory before they are streamed."""

    def __setattr__(self, name: str, value: object) -> None:
        """Keep ``data`` absolute, so that a saved config.yml works from any folder."""
        super().__setattr__(name, absolute(value) if name == "data" else value)


class BeagsDataManager(FullImageDatamanager[BeagsDataset]):
    """nerfstudio's data manager of full images, for CPUs too, with class maps in every batch.

    Batches hold ``image`` [H, W, 3], ``labels`` [H, W] int32 and ``alpha`` [H, W] uint8 where the image has it, all
    on the device, and, once ``replace_labels`` was called, ``present``, the objects of ``labels``. A training
    camera's metadata holds its ``labels`` too. The cache holds class maps in the narrowest type. Training views come
    in a random order without repetition within a round, given by ``train_cameras_sampling_seed`` alone.
    """

    config: BeagsDataManagerConfig
    train_dataset: BeagsDataset
    eval_dataset: BeagsDataset

    def __init__(self, config: BeagsDataManagerConfig, *args, **kwargs) -> None:
        super().__init__(config, *args, **kwargs)
        self._distorted = {"train": deepcopy(self.train_dataset.cameras), "eval": deepcopy(self.eval_dataset.cameras)}
        straighten(self.train_dataset.cameras)
        straighten(self.eval_dataset.cameras)
        self.train_cameras = self.train_dataset.cameras.to(self.device)
        self._cameras: dict[int, Camera] = {}
        self._present: list[list[int]] | None = None  # objects of each training view's class map, once replaced
        self._replaced = False  # whether the training class maps are no longer those of the files
        self._originals_kept = True
        self._originals: list[Tensor] | None = None  # those of the files, where they are kept beside the ones in use
        # nerfstudio draws evaluation views from Python's global generator, which others use too.
        self._eval_order = random.Random(config.train_cameras_sampling_seed)

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: Literal["cpu", "gpu"]) -> Any:
        """The data of all views, in memory or streamed."""
        dataset = self._dataset(split)
        load = partial(self._load_view, split)
        if self.streams(split):
            CONSOLE.print(
                f"{len(dataset)} {split} images would take {self._cache_gb(split):.1f} GB: they are read when needed.",
                highlight=False,
            )
            workers = self.config.max_thread_workers or min(4, os.cpu_count() or 1)
            return StreamedViews(load, len(dataset), READ_AHEAD, workers)
        with ThreadPoolExecutor(max_workers=self.config.max_thread_workers or 2) as pool:
            found = pool.map(load, range(len(dataset)))
            cache = list(track(found, f"Reading {split} images", total=len(dataset), transient=True))
        # "cpu" pins memory, which needs CUDA; "gpu" means self.device, whatever that is.
        pinned = cache_images_device == "cpu" and torch.device(self.device).type != "cpu"
        for data in cache:
            data["image"] = data["image"].pin_memory() if pinned else data["image"].to(self.device)
            if not pinned:
                data.update({key: data[key].to(self.device) for key in OWN_KEYS if key in data})
        return cache

    def streams(self, split: Literal["train", "eval"]) -> bool:
        """Whether the images of a split are read from disk whenever they are needed."""
        if self.config.stream == "auto":
            return self._cache_gb(split) > self.config.stream_above_gb
        return self.config.stream == "always"

    def _cache_gb(self, split: Literal["train", "eval"]) -> float:
        bytes_of_pixel = 3 * (1 if self.config.cache_images_type == "uint8" else 4)
        return sum(width * height for width, height in self._dataset(split).file_sizes) * bytes_of_pixel / 1e9

    def _dataset(self, split: str) -> BeagsDataset:
        return self.train_dataset if split == "train" else self.eval_dataset

    def _load_view(self, split: Literal["train", "eval"], index: int) -> dict[str, Any]:
        """Image, class map and alpha of one view from its files, without lens distortion."""
        dataset, distorted = self._dataset(split), self._distorted[split]
        data = dataset.get_data(index, image_type=self.config.cache_images_type)
        if has_lens(distorted, index):
            data["image"] = torch.from_numpy(undistort_image(data["image"].numpy(), distorted, index))
        lens = (distorted, dataset.cameras, index)
        labels = undistort_labels(data["labels"].numpy(), *lens)
        if labels.shape != tuple(data["image"].shape[:2]):
            raise RuntimeError(f"class map {labels.shape} and image {data['image'].shape} differ in size")
        data["labels"] = to_compact(torch.from_numpy(labels.astype(np.int32)))
        if (alpha := dataset.get_alpha(index)) is not None:
            data["alpha"] = torch.from_numpy(undistort_alpha(alpha, *lens))
        return data

    def _straight(self, split: Literal["train", "eval"], labels: np.ndarray, index: int) -> np.ndarray:
        """A class map [h, w] of a view, of any size, as it would be had the camera no lens distortion."""
        return undistort_labels(labels, self._distorted[split], self._dataset(split).cameras, index)

    def _labels_of_file(self, split: Literal["train", "eval"], index: int) -> Tensor:
        """The labels of a view's mask file in the narrowest type, without its photo."""
        labels = self._dataset(split).get_metadata({"image_idx": index})["labels"].numpy()
        return to_compact(torch.from_numpy(self._straight(split, labels, index).astype(np.int32)))

    def undistort_eval_map(self, labels: np.ndarray, index: int) -> np.ndarray:
        """A class map [h, w] of an evaluation view, of any size, as it would be had the camera no lens distortion."""
        return self._straight("eval", labels, index)

    def training_mask(self, index: int) -> np.ndarray | None:
        """The class map [h, w] uint16 in a training view's mask file, without lens distortion; None without a file."""
        if self.train_dataset.metadata["mask_filenames"][index] is None:
            return None
        return self._straight("train", self.train_dataset.get_metadata({"image_idx": index})["labels"].numpy(), index)

    def straight_train_map(self, labels: np.ndarray, index: int) -> np.ndarray:
        """A class map [h, w] of a training view's file without its lens distortion."""
        return self._straight("train", labels, index)

    def as_in_file(
        self, labels: np.ndarray, index: int, border: int = IGNORE, split: Literal["train", "eval"] = "train"
    ) -> np.ndarray:
        """A class map [h', w'] of a view with the lens distortion of its file, at the size it was read at.

        border: what is where the straight view does not reach.
        """
        width, height = self._dataset(split).file_sizes[index]
        lens = (self._distorted[split], self._dataset(split).cameras, index)
        return redistort_labels(labels, *lens, (height, width), border)

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        own = processes.rank()  # each process draws a view of its own, from an order that all have
        self._pass_over(own)
        camera, data = super().next_train(step)
        self._pass_over(processes.size() - own - 1)
        if isinstance(self.cached_train, StreamedViews):
            self.cached_train.expect(self.train_unseen_cameras)
        data = self._on_device(data)
        # the boundary is computed inside the rasterizer, which sees the camera only: the mask travels with it
        metadata = camera.metadata or {}
        camera.metadata = {**metadata, "labels": data["labels"], "camera": self._camera(metadata["cam_idx"])}
        if self._present is not None:
            data["present"] = self._present[metadata["cam_idx"]]
        return camera, data

    def _camera(self, index: int) -> Camera:
        """A training view's camera on the device, which knows its numbers on the host: a step need not fetch them."""
        if index not in self._cameras:
            self._cameras[index] = camera_from_nerfstudio(self.train_dataset.cameras, index).to(self.device)
        return self._cameras[index]

    def _pass_over(self, count: int) -> None:
        """Leave out training views, which other processes draw."""
        for _ in range(count):
            self.train_unseen_cameras.pop(0)
            if not self.train_unseen_cameras:
                self.train_unseen_cameras = self.sample_train_cameras()

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        index = self.eval_unseen_cameras.pop(self._eval_order.randrange(len(self.eval_unseen_cameras)))
        if not self.eval_unseen_cameras:
            self.eval_unseen_cameras = list(range(len(self.eval_dataset)))
        data = self.cached_eval[index].copy()
        data["image"] = data["image"].to(self.device)
        return self.eval_dataset.cameras[index : index + 1].to(self.device), self._on_device(data)

    def state(self) -> dict[str, Any]:
        """Where the orders of the training and evaluation views are; see ``resumable.Resumable``."""
        generator = getattr(self, "random_generator", None)  # nerfstudio's "fps" has none
        epochs = getattr(self, "train_unsampled_epoch_count", None)
        return {
            "sizes": [len(self.train_dataset), len(self.eval_dataset)],
            "train": [int(index) for index in self.train_unseen_cameras],
            "eval": list(self.eval_unseen_cameras),
            "train_generator": None if generator is None else generator.getstate(),
            "train_epochs": None if epochs is None else epochs.tolist(),
            "eval_generator": self._eval_order.getstate(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with the views in the order in which the run that gave ``state`` would have."""
        now = [len(self.train_dataset), len(self.eval_dataset)]
        if (began := list(state["sizes"])) != now:
            raise UserError(
                f"training began with {began[0]} views and {began[1]} held out, but {self.config.data} has {now[0]} "
                f"and {now[1]} now: restore the data, or train again."
            )
        self.train_unseen_cameras = list(state["train"])
        self.eval_unseen_cameras = list(state["eval"])
        self._eval_order.setstate(state["eval_generator"])
        if state["train_generator"] is not None and hasattr(self, "random_generator"):
            self.random_generator.setstate(state["train_generator"])
        if state["train_epochs"] is not None:
            self.train_unsampled_epoch_count = np.array(state["train_epochs"])

    @property
    def fixed_indices_eval_dataloader(self) -> Any:
        """All evaluation views in order, as nerfstudio's evaluation reads them, one at a time."""
        cache = self.cached_eval

        def batch(index: int) -> tuple[Cameras, dict]:
            data = self._on_device(cache[index].copy())
            data["image"] = data["image"].to(self.device)
            return self.eval_dataset.cameras[index : index + 1].to(self.device), data

        return Lazy(batch, len(cache))

    def views(self, split: Literal["train", "val", "test", "eval"], original: bool = False) -> list[View]:
        """All views of the training or (any other name) the evaluation split, in name order.

        original: give the labels of the mask files also after ``replace_labels``, if it kept them.
        """
        if split not in ("train", "val", "test", "eval"):
            raise ValueError(f"unknown split {split!r}")
        whose: Literal["train", "eval"] = "train" if split == "train" else "eval"
        cache = self.cached_train if whose == "train" else self.cached_eval
        names = unique_names(self._dataset(whose).image_filenames)
        return [self._view(whose, cache, index, name, original) for index, name in enumerate(names)]

    def replace_labels(self, labels: Sequence[Tensor], keep: bool = True) -> None:
        """Train on ``labels``, one [H, W] integer tensor per training view, instead of the mask files.

        keep: whether ``views`` may be asked for the labels of the files later on.
        Raises ``ValueError`` if their number, a size or an id (0..IGNORE) is wrong.
        """
        cache, cameras = self.cached_train, self.train_dataset.cameras
        if len(labels) != len(cache):
            raise ValueError(f"labels of {len(labels)} views for {len(cache)} training views")
        present = []
        for index, each in enumerate(labels):
            shape = (int(cameras.height[index]), int(cameras.width[index]))
            if each.shape != shape:
                raise ValueError(f"labels {tuple(each.shape)} for a view of {shape}")
            if each.numel() and not 0 <= int(each.min()) <= int(each.max()) <= IGNORE:
                raise ValueError(f"class ids must lie in 0..{IGNORE}")
            present.append(objects_in(each))
        if isinstance(cache, StreamedViews):
            cache.labels = [CompressedMap(each.int()) for each in labels]
        else:
            if not self._replaced:
                self._originals = [data["labels"] for data in cache]
            for data, each in zip(cache, labels, strict=True):
                data["labels"] = to_compact(each.detach().int()).to(data["labels"].device)
        self._originals = self._originals if keep else None
        self._originals_kept = keep
        self._present = present
        self._replaced = True

    def _view(self, split: Literal["train", "eval"], cache: Any, index: int, name: str, original: bool) -> View:
        dataset = self._dataset(split)
        replaced = self._replaced and split == "train"
        if replaced and original:
            if not self._originals_kept:
                raise ValueError("the labels of the mask files were not kept")
            replaced = False
        labels: Callable[[], Tensor] | None = None
        if replaced or dataset.metadata["mask_filenames"][index] is not None:
            labels = self._labels(split, cache, index, replaced)
        camera = camera_from_nerfstudio(dataset.cameras, index).to(self.device)

        def data() -> dict[str, Tensor]:
            held = cache[index]
            return {key: held[key].to(self.device) for key in ("image", "alpha") if key in held}

        return View(camera, name, data, labels)

    def _labels(self, split: Literal["train", "eval"], cache: Any, index: int, replaced: bool) -> Callable[[], Tensor]:
        """What gives the labels that a view has now, also after they are replaced again."""
        if isinstance(cache, StreamedViews):
            packed = cache.labels[index] if replaced else None
            if packed is None:
                return lambda: self._labels_of_file(split, index).to(self.device)
            return lambda: packed.unpacked().to(self.device)
        original = self._replaced and split == "train" and not replaced
        stored = self._originals[index] if original and self._originals is not None else cache[index]["labels"]
        return lambda: stored.to(self.device)

    def _on_device(self, data: dict) -> dict:
        """The view's data for use: class map and alpha on the device, the class map as int32."""
        moved = {key: value.to(self.device) if key in OWN_KEYS else value for key, value in data.items()}
        return {**moved, "labels": to_int32(moved["labels"])}
