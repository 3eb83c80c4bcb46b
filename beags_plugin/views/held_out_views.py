"""The held-out views of a run's data, for evaluation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, overload

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera, cropped
from beags_plugin.data.files import image_size, same_proportions
from beags_plugin.data.ground_truth import GroundTruth
from beags_plugin.evaluation.records import EvalView, FullPhoto
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_id_mask, read_object_mask
from beags_plugin.system.errors import UserError
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.photo_files import Box
from beags_plugin.views.run_data import BothSplits

_NO_TRUTH = GroundTruth(masks=[], visible={}, silhouettes={})


class HeldOutViews(Sequence[EvalView]):
    """The test views of the data; the masks of a view are read when it is indexed, at the size of their files.

    Masks of all visible objects come from ``ground_truth/masks``, else from the data's own masks, unless a program drew
    these (``labels.classes.NO_TRUTH``). Files of single objects come from the folders of ``data.ground_truth``, or from
    the layout. All are undistorted like the photos. Indexing raises ``UserError`` for a file that cannot be read, or
    whose proportions differ from its photo's.
    """

    def __init__(self, manager: BothSplits, classes: Mapping[int, str], background: Tensor) -> None:
        """Open the views. classes: id to name. background: [3], colour behind photos with alpha, as in training."""
        self.manager = manager
        self.classes = classes
        self.background = background.cpu()
        self._views = self.manager.views("test")
        self._metadata = self.manager.eval_dataset.metadata

    def __len__(self) -> int:
        return len(self._views)

    @overload
    def __getitem__(self, index: int) -> EvalView: ...
    @overload
    def __getitem__(self, index: slice) -> list[EvalView]: ...
    def __getitem__(self, index: int | slice) -> EvalView | list[EvalView]:
        chosen = range(len(self))[index]
        return self._view(chosen) if isinstance(chosen, int) else [self._view(i) for i in chosen]

    @property
    def no_truth(self) -> Path | None:
        """Return the file that says that a program drew the data's masks; None if they count as ground truth."""
        return self._metadata["no_truth"]

    @property
    def stray_truth(self) -> str | None:
        """Return a sentence on exact masks that belong to no view of the data; None without any."""
        return self._metadata["stray_truth"]

    def trained_on(self) -> int:
        """Return how many of these views are also training views."""
        trained = set(self.manager.train_dataset.image_filenames)
        return sum(path in trained for path in self.manager.eval_dataset.image_filenames)

    def cameras(self, split: Literal["train", "eval"]) -> list[Camera]:
        """Return the cameras of the training or the held-out views, without lens distortion; no photo is read."""
        cameras = (self.manager.train_dataset if split == "train" else self.manager.eval_dataset).cameras
        return [camera_from_nerfstudio(cameras, index) for index in range(len(cameras))]

    @property
    def names(self) -> list[str]:
        """Return the names of the views; no photo is read."""
        return [view.name for view in self._views]

    def _view(self, index: int) -> EvalView:
        view = self._views[index]
        truth = self._metadata["ground_truth"] or _NO_TRUTH
        exact = truth["masks"][index] if truth["masks"] else None
        # If objects were labelled one by one, a view without such masks has no ground truth, whatever its own mask.
        trusted = self.no_truth is None and not truth["visible"]
        own = self._metadata["mask_filenames"][index] if trusted else None
        visible = None
        if (file := exact or own) is not None:
            ids = read_id_mask(file, self._metadata["ignore_ids"])
            visible = torch.from_numpy(self._straight(file, ids, index).astype(np.int32))
        silhouettes, unknown_silhouettes = self._per_object(truth["silhouettes"], index)
        visible_objects, unknown_visible = self._per_object(truth["visible"], index)
        return EvalView(
            view.camera,
            view.image_on(self.background),
            visible,
            silhouettes or None,
            view.name,
            visible_objects or None,
            unknown_silhouettes or None,
            unknown_visible or None,
            self._full(index, view.camera),
        )

    def _full(self, index: int, camera: Camera) -> FullPhoto | None:
        """Return the photo of a view at the size of its file; None if training uses that size."""
        files = self.manager.files["eval"]
        full = files.full_camera(index)
        if (full.width, full.height) == (camera.width, camera.height):
            return None

        def region(box: Box) -> tuple[Camera, Tensor]:
            left, top, right, bottom = box
            pixels = files.full_regions(index, [box])[0]
            photo = pixels["image"].float() / 255.0
            if "alpha" in pixels:
                photo = photo + (1.0 - pixels["alpha"].float() / 255.0)[..., None] * self.background
            return cropped(full, left, top, right - left, bottom - top), photo

        return FullPhoto(full, region)

    def _per_object(
        self, files: Mapping[str, Sequence[Path | None]], view: int
    ) -> tuple[dict[int, Tensor], dict[int, Tensor]]:
        """Read the [h, w] bool masks of a view by object id, and their unknown pixels if there are any."""
        masks, unknown = {}, {}
        for class_id, name in self.classes.items():
            if name not in files or (file := files[name][view]) is None:
                continue
            ids = self._straight(file, read_object_mask(file, truth=True), view)
            masks[class_id] = torch.from_numpy(ids == 1)
            if (unlabelled := ids == IGNORE).any():  # Pixels outside the lens are among them.
                unknown[class_id] = torch.from_numpy(unlabelled)
        return masks, unknown

    def _straight(self, file: Path, ids: np.ndarray, view: int) -> np.ndarray:
        """Undistort ids; raise ``UserError`` if their proportions differ from the photo's."""
        (own_height, own_width), size = ids.shape, image_size(self.manager.eval_dataset.image_filenames[view])
        if not same_proportions(size, (own_width, own_height)):
            raise UserError(
                f"the mask {file} is {own_width}x{own_height} pixels but its image is {size[0]}x{size[1]}: make it in "
                "the proportions of the image."
            )
        return self.manager.files["eval"].undistorted(ids, view)
