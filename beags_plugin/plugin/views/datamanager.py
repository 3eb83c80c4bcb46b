"""Data manager of full images, with the labels of each view undistorted like its image."""

from __future__ import annotations

import os
import random
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.configs.dataparser_configs import AnnotatedDataParserUnion
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from rich.progress import track
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.labels.label_maps import CompressedMap, to_compact, to_int32
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig
from beags_plugin.plugin.views.dataset import BeagsDataset
from beags_plugin.system.errors import UserError
from beags_plugin.system.program import path_option, program_name
from beags_plugin.system.progress import say
from beags_plugin.views.cameras import camera_from_nerfstudio, take_intrinsics
from beags_plugin.views.close_ups import CloseUps
from beags_plugin.views.data_options import ViewOptions
from beags_plugin.views.dense_seeds import MOST_PHOTOS, with_dense_seeds
from beags_plugin.views.focus import aim_by, focused
from beags_plugin.views.objects_alone import objects_alone
from beags_plugin.views.photo_files import PhotoFiles
from beags_plugin.views.run_data import Split
from beags_plugin.views.streaming import Lazy, StreamedViews
from beags_plugin.views.views import View, unique_names

READ_AHEAD = 8  # Streamed images that are read before their use.
OWN_KEYS = ("labels", "alpha")


@dataclass
class BeagsDataManagerConfig(ViewOptions, FullImageDatamanagerConfig):
    """Options of the data manager."""

    _target: type = field(default_factory=lambda: BeagsDataManager)
    dataparser: AnnotatedDataParserUnion = field(default_factory=BeagsDataParserConfig)


class BeagsDataManager(FullImageDatamanager[BeagsDataset]):
    """nerfstudio's data manager of full images, for CPUs too, with labels in every batch.

    Batches hold ``image`` [H, W, 3], ``labels`` [H, W] int32 and ``alpha`` [H, W] uint8 where the image has it, all
    on the device, and, once ``replace_labels`` was called, ``present``, the objects of ``labels``; with the option
    ``photos objects``, what ``objects_alone`` adds for training. The cache holds labels in the narrowest type. Training
    views come in a random order without repetition within a round, given by ``train_cameras_sampling_seed`` alone.
    """

    config: BeagsDataManagerConfig
    train_dataset: BeagsDataset
    eval_dataset: BeagsDataset

    def __init__(self, config: BeagsDataManagerConfig, *args, **kwargs) -> None:
        super().__init__(config, *args, **kwargs)
        self.files: dict[Split, PhotoFiles] = {
            "train": PhotoFiles(self.train_dataset), "eval": PhotoFiles(self.eval_dataset)
        }  # fmt: skip
        self.train_cameras = self.train_dataset.cameras.to(self.device)
        self._cameras: dict[int, Camera] = {}
        _ = self.cached_train  # Photos are read now, so that a bad one is reported first.
        self.close_ups: CloseUps | None = None  # Set by ``focus``.
        self._present: list[list[int]] | None = None  # Objects of each training view's labels, once they are replaced.
        # Nerfstudio samples evaluation views by Python's global generator, which other code uses too.
        self._eval_order = random.Random(config.train_cameras_sampling_seed)
        self._add_dense_seeds()

    def get_datapath(self) -> Path:
        """Return the folder for a viewer's camera paths: of the run that ns-viewer opens, else of the photos.

        The photos' folder may belong to somebody else, or be read-only.
        """
        config_path = path_option("--load-config") if program_name() == "ns-viewer" else None
        return super().get_datapath() if config_path is None else config_path.absolute().parent

    def focus(self, loaded: bool | None = None) -> None:
        """Show close-ups of objects to training from here on, if the option ``focus`` says so.

        loaded: whether the training that this one goes on with saw some; None if there is none.
        """
        config, names = self.config, unique_names(self.train_dataset.image_filenames)
        wanted = config.begins if loaded is None else loaded
        self.close_ups = focused(
            "off" if config.focus == "auto" and not wanted else config.focus,
            self.files["train"],
            partial(self._labels, "train", original=True),
            names,
            config.train_cameras_sampling_seed,
        )

    @property
    def magnified(self) -> float:
        """How much larger close-ups show objects than whole photos, in the mean; 1 without close-ups."""
        return 1.0 if self.close_ups is None else self.close_ups.gain

    def _add_dense_seeds(self) -> None:
        """Add seed points on which photos agree, if the option says so and there are points to begin with."""
        seeds, option = self.train_dataparser_outputs.metadata, self.config.dense_seeds
        few = len(self.train_dataset) <= MOST_PHOTOS and self.config.photos == "all"
        if self.config.begins and not seeds["points3D_random"] and (option == "on" or (option == "auto" and few)):
            seeds["points3D_xyz"], seeds["points3D_rgb"] = with_dense_seeds(
                self.views("train"), seeds["points3D_xyz"], seeds["points3D_rgb"]
            )

    def _load_images(self, split: Split, cache_images_device: Literal["cpu", "gpu"]) -> Any:
        """Return the data of all views, in memory or streamed."""
        dataset = self._dataset(split)
        load = partial(self.files[split].load, image_type=self.config.cache_images_type)
        if self.streams(split):
            say(f"{len(dataset)} {split} images would take {self._cache_gb(split):.1f} GB: they are read when needed.")
            workers = self.config.max_thread_workers or min(4, os.cpu_count() or 1)
            return StreamedViews(load, len(dataset), READ_AHEAD, workers)
        with ThreadPoolExecutor(max_workers=self.config.max_thread_workers or 2) as pool:
            loaded = pool.map(load, range(len(dataset)))
            cache = list(track(loaded, f"Reading {split} images", total=len(dataset), transient=True))
        # Nerfstudio means pinned memory by "cpu", which needs CUDA, and self.device by "gpu".
        pinned = cache_images_device == "cpu" and torch.device(self.device).type != "cpu"
        for data in cache:
            data["image"] = data["image"].pin_memory() if pinned else data["image"].to(self.device)
            if not pinned:
                data.update({key: data[key].to(self.device) for key in OWN_KEYS if key in data})
        return cache

    def streams(self, split: Split) -> bool:
        """Return whether the images of a split are read from disk whenever they are needed."""
        return self.config.streams(self._cache_gb(split))

    def _cache_gb(self, split: Split) -> float:
        bytes_of_pixel = 3 * (1 if self.config.cache_images_type == "uint8" else 4)
        return sum(width * height for width, height in self._dataset(split).file_sizes) * bytes_of_pixel / 1e9

    def _dataset(self, split: Split) -> BeagsDataset:
        return self.train_dataset if split == "train" else self.eval_dataset

    # -- batches -----------------------------------------------------------------------------------------------------

    def next_train(self, step: int) -> tuple[Cameras, dict]:
        camera, data = super().next_train(step)
        if isinstance(self.cached_train, StreamedViews):
            self.cached_train.expect(self.train_unseen_cameras)
        metadata = camera.metadata or {}
        index = metadata["cam_idx"]
        own_camera, data = self._batch_of(index, data, step)
        if own_camera is not self._camera(index):
            take_intrinsics(camera, own_camera)
        own = {"labels": data["labels"], "camera": own_camera, "objects_alone": "inside" in data}
        own["close_up"] = data.get("close_up", False)
        camera.metadata = metadata | own
        if self._present is not None:
            data.setdefault("present", self._present[index])
        return camera, data

    def _batch_of(self, index: int, cached: dict, step: int) -> tuple[Camera, dict]:
        """Return camera and batch of a view for ``step``: a close-up or the whole view. cached: its data."""
        if self.close_ups is not None and (close_up := self.close_ups.drawn(index, step)) is not None:
            camera, data = close_up
            present = {} if self._present is None else {"present": objects_in(to_int32(data["labels"]))}
            data = self._as_wanted({**data, **present, "image": data["image"].to(self.device)})
            return camera.to(self.device), data
        return self._camera(index), self._as_wanted(cached)

    def _as_wanted(self, cached: dict) -> dict:
        """Return data on the device, of the whole photo or of its objects alone, as the option ``photos`` says."""
        data = self._on_device(cached)
        return objects_alone(data) if self.config.photos == "objects" else data

    def _camera(self, index: int) -> Camera:
        """Return a training view's whole camera on the device; the host has its numbers too, so no step waits."""
        if index not in self._cameras:
            self._cameras[index] = camera_from_nerfstudio(self.train_dataset.cameras, index).to(self.device)
        return self._cameras[index]

    def next_eval_image(self, step: int) -> tuple[Cameras, dict]:
        index = self.eval_unseen_cameras.pop(self._eval_order.randrange(len(self.eval_unseen_cameras)))
        if not self.eval_unseen_cameras:
            self.eval_unseen_cameras = list(range(len(self.eval_dataset)))
        return self._eval_batch(index)

    @property
    def fixed_indices_eval_dataloader(self) -> Any:
        """All evaluation views in order, as nerfstudio's evaluation reads them, one at a time."""
        return Lazy(self._eval_batch, len(self.eval_dataset))

    def _eval_batch(self, index: int) -> tuple[Cameras, dict]:
        data = self._on_device(self.cached_eval[index])
        data["image"] = data["image"].to(self.device)
        return self.eval_dataset.cameras[index : index + 1].to(self.device), data

    def _on_device(self, data: dict) -> dict:
        """Return the view's data with labels (as int32) and alpha on the device."""
        moved = {key: value.to(self.device) if key in OWN_KEYS else value for key, value in data.items()}
        return {**moved, "labels": to_int32(moved["labels"])}

    # -- the order of the views, in checkpoints ----------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """Return the state of the orders of training and evaluation views; see ``Resumable``."""
        generator = getattr(self, "random_generator", None)  # Nerfstudio's sampling "fps" has none.
        epochs = getattr(self, "train_unsampled_epoch_count", None)
        return {
            "sizes": [len(self.train_dataset), len(self.eval_dataset)],
            "train": [int(index) for index in self.train_unseen_cameras],
            "eval": list(self.eval_unseen_cameras),
            "train_generator": None if generator is None else generator.getstate(),
            "train_epochs": None if epochs is None else epochs.tolist(),
            "eval_generator": self._eval_order.getstate(),
            "close_ups": self.close_ups is not None,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue the orders from ``state``."""
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

    # -- views and their labels --------------------------------------------------------------------------------------

    def views(self, split: Literal["train", "val", "test", "eval"], original: bool = False) -> list[View]:
        """Return all views of the training or (any other name) the evaluation split, in name order.

        original: whether labels come from the mask files even after ``replace_labels``.
        """
        if split not in ("train", "val", "test", "eval"):
            raise ValueError(f"unknown split {split!r}")
        whose: Split = "train" if split == "train" else "eval"
        cache, dataset = self.cached_train if whose == "train" else self.cached_eval, self._dataset(whose)

        def view(index: int, name: str) -> View:
            def data() -> dict[str, Tensor]:
                cached = cache[index]
                return {key: cached[key].to(self.device) for key in ("image", "alpha") if key in cached}

            camera = camera_from_nerfstudio(dataset.cameras, index).to(self.device)
            return View(camera, name, data, partial(self._labels, whose, index, original))

        return [view(index, name) for index, name in enumerate(unique_names(dataset.image_filenames))]

    def _labels(self, split: Split, index: int, original: bool) -> Tensor | None:
        """Return a view's labels [H, W] int32 without reading its photo; None without a mask."""
        if split == "eval" or original or self._present is None:
            mask = self.files[split].mask_labels(index)
            return None if mask is None else torch.from_numpy(mask.astype(np.int32)).to(self.device)
        cache = self.cached_train
        labels = cache.labels[index].unpacked() if isinstance(cache, StreamedViews) else cache[index]["labels"]
        return to_int32(labels.to(self.device))

    def close_up_views(self) -> list[View]:
        """Return the close-ups that training sees, as views; none without focus."""
        return [] if self.close_ups is None else list(self.close_ups.views(self.device))

    def replace_labels(self, labels: Sequence[Tensor], of_close_ups: Sequence[Tensor] = ()) -> None:
        """Train on the labels M' of reprojected masks instead of those of the mask files (method, section 2).

        ``next_train`` passes them to the model in ``camera.metadata["labels"]`` too, since the rasterizer, which gets
        no batch, renders the class boundary against them. labels: [H, W] integers of each training view. of_close_ups:
        the same of each of ``close_up_views``. Raises ``ValueError`` if their number, a size or an
        id (0..IGNORE) is wrong.
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
            for data, each in zip(cache, labels, strict=True):
                data["labels"] = to_compact(each.detach().int()).to(data["labels"].device)
        self._present = present
        if self.close_ups is not None:
            self.close_ups.replace_labels(of_close_ups)
            aim_by(self.close_ups, self.files["train"], labels)
