"""Sources of masks: images of ids in any folder, and those of Gaussian Grouping."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import IGNORE, count_ids
from beags_plugin.labels.classes import read_classes, read_id_mask
from beags_plugin.labels.id_checks import check_areas, check_ids
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene, per_photo
from beags_plugin.masks.sources.matching import files_by_name
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.wording import amount


@dataclass(frozen=True)
class IdImagesSource(MaskSource):
    """Images of ids with the names of the photos: grey or palette images, or colour images with an id per colour.

    folder: of the images. names: JSON {"id": "name"}, or None. colors: read colour images; black is the background,
    other colours get ids 1, 2, ... in order of appearance. ignore_ids: ids that mean "not labelled". least_views: ids
    in fewer images become background; 0 keeps all.
    """

    folder: Path = Path("masks")
    names: Path | None = None
    colors: bool = False
    ignore_ids: tuple[int, ...] = ()
    least_views: int = 0

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        folder = scene.below(self.folder)
        files = scene.by_photo(files_by_name(folder))
        if not files:
            raise UserError(f"{folder} holds no image with the name of a photo: give options folder=...")
        palette: dict[int, int] = {}
        views: Counter[int] = Counter()
        for photo in scene.photos:
            if photo.name in files:
                present, _ = count_ids(self._ids(files[photo.name], palette))
                views.update(i for i in present.tolist() if i not in (0, IGNORE))
        used = {i for i, count in views.items() if count >= self.least_views}
        names = read_classes(None if self.names is None else scene.below(self.names), sorted(used))
        notes = [f"{amount(len(views) - len(used), 'id')} in fewer than {self.least_views} views became background."]

        def read(photo: Photo) -> np.ndarray | None:
            if photo.name not in files:
                return None
            ids = self._ids(files[photo.name], palette)
            ids[~np.isin(ids, [*used, 0, IGNORE])] = 0
            return ids

        return MadeMasks(names, per_photo(scene, progress, read), notes if len(used) < len(views) else [])

    def _ids(self, path: Path, palette: dict[int, int]) -> np.ndarray:
        if not self.colors:
            labels = read_id_mask(path, self.ignore_ids)
            check_ids(path, labels)
            return labels
        form, pixels = read_image(
            path,
            lambda image: (image.format, np.asarray(image.convert("RGB")).astype(np.uint32)),
            "the mask",
            "save it as PNG again",
        )
        if form == "JPEG":
            raise UserError(f"the mask {path} is a JPEG, which blurs the colours of objects: save it as PNG.")
        packed = pixels[..., 0] << 16 | pixels[..., 1] << 8 | pixels[..., 2]
        colors, inverse = np.unique(packed, return_inverse=True)
        inverse = inverse.reshape(packed.shape)
        check_areas(path, inverse, "colours")
        for color in colors.tolist():
            if color and len(palette) >= IGNORE - 1:
                raise UserError(f"{path} and those before it hold more than {IGNORE - 1} colours: it is no id image.")
            if color:
                palette.setdefault(color, len(palette) + 1)
        ids = np.array([palette.get(color, 0) for color in colors.tolist()], np.uint16)
        return ids[inverse]


@dataclass(frozen=True)
class GaussianGroupingSource(IdImagesSource):
    """The ``object_mask`` folder of Gaussian Grouping's tracker: grey ids, many of them in few views."""

    folder: Path = Path("object_mask")
    least_views: int = 3
