"""Parts of a run that a viewer shows besides its scene: the training views and their masks."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.runs.layout import EXTRACTION_FILE, PREPARED, digest_of_prepared, files_digest, preparing_run
from beags_plugin.runs.run import Run
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.views import unique_names

if TYPE_CHECKING:
    from beags_plugin.plugin.views.datamanager import BeagsDataManager

_KEPT_MASKS = 8  # Masks in memory, of the last views.


class ViewedRun:
    """A run on disk with its data manager.

    folder: of the run. names: of the training views. cameras: theirs, without lens distortion.
    """

    def __init__(self, folder: Path, datamanager: BeagsDataManager) -> None:
        self.folder = folder
        self.datamanager = datamanager
        dataset = datamanager.train_dataset
        self.names = unique_names(dataset.image_filenames)
        self.has_masks = any(path is not None for path in dataset.metadata["mask_filenames"])
        cameras = dataset.cameras
        self.cameras: list[Camera] = [camera_from_nerfstudio(cameras, index) for index in range(len(cameras))]
        self._before = lru_cache(_KEPT_MASKS)(datamanager.files["train"].mask_labels)
        self.refining: Callable[[], bool] = lambda: True  # Whether the scene has been prepared.
        self._after = lru_cache(_KEPT_MASKS)(_read_mask)
        self._kept = digest_of_prepared(folder) if (folder / EXTRACTION_FILE).exists() else None
        self._digest = lru_cache(1)(lambda folder, _changed: files_digest(folder))

    def opened(self) -> Run:
        """Open the run as it is on disk now (training and picking change it), with the photos that the viewer shows."""
        data = self.datamanager.config.data
        return Run(self.folder / "config.yml", None if data is None else Path(data).absolute())

    @property
    def prepared(self) -> Path | None:
        """Return the folder of the preparation: of this run, or of its origin.

        None if the shown scene has not been prepared yet (the folder may hold files of a former run), or if the origin
        of an extracted run has been prepared again.
        """
        folder = self._folder()
        return None if folder is None or self._replaced(folder) else folder

    @property
    def note(self) -> str | None:
        """Return a sentence for users if the files on disk no longer belong to this scene's preparation."""
        folder = self._folder()
        if folder is None or not self._replaced(folder):
            return None
        return (
            f"No masks after reprojection: {preparing_run(self.folder)} has been trained again since this was "
            "extracted from it. Extract it again."
        )

    def _folder(self) -> Path | None:
        """Return the folder of the preparation if the scene has been prepared and the folder is complete; else None."""
        folder = preparing_run(self.folder) / PREPARED
        return folder if self.refining() and (folder / "grid.pt").exists() else None

    def _replaced(self, folder: Path) -> bool:
        """Return whether the folder has changed since this run was extracted; False if unknown."""
        if self._kept is None:
            return False
        try:
            now = self._digest(folder, (folder / "grid.pt").stat().st_mtime_ns)
        except OSError:  # The folder is being replaced.
            return True
        return now != self._kept

    def mask(self, view: int, kind: str, width: int, height: int) -> Tensor | None:
        """Return a training view's mask [height, width] int32 "before" or "after" reprojection; None without one.

        Raises ``UserError`` for a file that cannot be read.
        """
        if kind == "before":
            ids = self._before(view)
        else:
            path = None if self.prepared is None else self.prepared / "masks" / f"{self.names[view]}.png"
            ids = self._after(path, path.stat().st_mtime_ns) if path is not None and path.exists() else None
        return None if ids is None else torch.from_numpy(resize_nearest(ids, height, width).astype(np.int32))


def _read_mask(path: Path, _changed: int) -> np.ndarray:
    """Read a mask; with the time of the last change as argument, a cache reads changed files again."""
    return read_id_mask(path)
