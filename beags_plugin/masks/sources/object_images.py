"""Source of masks: one image per object and view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import read_object_mask
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene, per_photo, stacked
from beags_plugin.masks.sources.matching import files_by_name
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class ObjectImagesSource(MaskSource):
    """One image per object and view: <folder>/<object>/<stem>.png, or <folder>/<stem>/<object>.png.

    A stem is the name of a photo, with its folders. folder: of the images. Smaller objects cover larger ones. A view
    without an image has no mask.
    """

    folder: Path = Path("object_masks")

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        folder = scene.below(self.folder)
        file_of = self._files(scene, folder)
        if not file_of:
            raise UserError(
                f"{folder} holds neither <object>/<stem>.png nor <stem>/<object>.png for an image of the scene: "
                "give options folder=..."
            )
        objects = sorted({name for name, _ in file_of})
        ids = {name: index for index, name in enumerate(objects, 1)}

        def read(photo: Photo) -> np.ndarray | None:
            files = [(ids[name], file_of[name, photo.name]) for name in objects if (name, photo.name) in file_of]
            return self._stack(files) if files else None

        names = {0: "background", **{index: name for name, index in ids.items()}}
        return MadeMasks(names, per_photo(scene, progress, read), [])

    @staticmethod
    def _files(scene: SourceScene, folder: Path) -> dict[tuple[str, str], Path]:
        """Find the file of each (object, name of a photo): the object is the first part of a path, else the last."""
        by_object: dict[str, dict[str, Path]] = {}  # object, then view
        for name, path in files_by_name(folder).items():
            first, _, rest = name.partition("/")
            view, _, last = name.rpartition("/")
            readings = [(first, rest), (last, view)]  # object and view, in both orders
            fitting = [reading for reading in readings if scene.names.candidates(reading[1])]
            # ``PhotoNames.assigned`` refuses these.
            fitting += [reading for reading in readings if scene.names.in_other_folders(reading[1])]
            for each, of_view in fitting[:1]:
                if (other := by_object.setdefault(each, {}).setdefault(of_view, path)) is not path:
                    raise UserError(f"{other} and {path} are both {each} in {of_view}: remove one of them.")
        return {(each, name): path for each, files in by_object.items() for name, path in scene.by_photo(files).items()}

    @staticmethod
    def _stack(files: Sequence[tuple[int, Path]]) -> np.ndarray:
        masks = [(class_id, read_object_mask(path)) for class_id, path in files]
        sizes = {mask.shape for _, mask in masks}
        if len(sizes) > 1:
            raise UserError(f"{files[0][1]} and the other objects' masks of this view differ in size: make them alike.")
        height, width = sizes.pop()
        labels = stacked([(class_id, mask == 1) for class_id, mask in masks], (height, width))
        unknown = np.any([mask == IGNORE for _, mask in masks], axis=0)
        labels[unknown & (labels == 0)] = IGNORE
        return labels
