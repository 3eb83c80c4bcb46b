"""Source of masks: segments of single views by LangSplat's preprocessing, matched by their features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.sources.base import MadeMasks, MaskSource, Photo, Progress, SourceScene, per_photo
from beags_plugin.masks.sources.matching import files_by_name
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.arrays import load_array
from beags_plugin.system.reading.text import reason

LEVELS = ("default", "small", "medium", "large")


@dataclass(frozen=True)
class LangSplatSource(MaskSource):
    """Segments in ``<stem>_s.npy`` [4, H, W] (four sizes, -1: none), and their features in ``<stem>_f.npy`` [N, D].

    Each view numbers its segments anew; segments with similar features become one object. folder: of the files. level:
    size of the segments: default, small, medium or large. similarity: least cosine between the features of a segment
    and their mean over its object. least_views: objects in fewer views become background.
    """

    folder: Path = Path("language_features")
    level: Literal["default", "small", "medium", "large"] = "large"
    similarity: float = 0.85
    least_views: int = 3

    def make(self, scene: SourceScene, progress: Progress) -> MadeMasks:
        folder = scene.below(self.folder)
        segments_of = scene.by_photo(files_by_name(folder, ("_s.npy",)))
        if not segments_of:
            raise UserError(f"{folder} holds no <stem>_s.npy for an image of the scene: give options folder=...")
        tables = self._objects(segments_of)
        objects = sorted({int(i) for table in tables.values() for i in table.values()})
        if len(objects) > IGNORE - 1:
            raise UserError(
                f"{folder} gives {len(objects)} objects, but only {IGNORE - 1} ids can be saved: lower similarity."
            )
        ids = {i: index for index, i in enumerate(objects, 1)}

        def read(photo: Photo) -> np.ndarray | None:
            if photo.name not in tables:
                return None
            segments = self._segments(segments_of[photo.name])
            labels = np.where(segments < 0, IGNORE, 0).astype(np.uint16)
            for segment, index in tables[photo.name].items():
                labels[segments == segment] = ids[index]
            return labels

        names = {0: "background", **{index: f"object_{index}" for index in ids.values()}}
        return MadeMasks(names, per_photo(scene, progress, read), [])

    def _segments(self, path: Path) -> np.ndarray:
        maps = _array(path)
        if maps.ndim != 3 or len(maps) != len(LEVELS):
            raise UserError(f"{path} is {list(maps.shape)}, not [4, H, W]: give LangSplat's own files.")
        return maps[LEVELS.index(self.level)].astype(np.int64)

    def _objects(self, files: Mapping[str, Path]) -> dict[str, dict[int, int]]:
        """Return {segment: object} of each photo, without objects in few views. files: of the segments, by photo."""
        means: list[np.ndarray] = []  # sums of unit features, as only their directions count
        views: list[set[str]] = []
        tables: dict[str, dict[int, int]] = {}
        for name, path in files.items():
            file = path.with_name(path.name[: -len("_s.npy")] + "_f.npy")
            features = self._features(file)
            segments = np.unique(self._segments(path))
            tables[name] = {}
            for segment in segments[segments >= 0].tolist():
                if segment >= len(features):
                    raise UserError(f"{file} has no row for segment {segment}: make it again.")
                own = features[segment]
                cosines = [float(own @ mean) / float(np.linalg.norm(mean)) for mean in means]
                best = int(np.argmax(cosines)) if cosines else -1
                if best < 0 or cosines[best] < self.similarity:
                    best = len(means)
                    means.append(np.zeros_like(own))
                    views.append(set())
                means[best] = means[best] + own
                views[best].add(name)
                tables[name][segment] = best
        return {
            name: {segment: i for segment, i in table.items() if len(views[i]) >= self.least_views}
            for name, table in tables.items()
        }

    @staticmethod
    def _features(path: Path) -> np.ndarray:
        if not path.is_file():
            raise UserError(f"{path} is missing: without features, segments of two views cannot be matched.")
        features = _array(path).astype(np.float64)
        if features.ndim != 2:
            raise UserError(f"{path} is {list(features.shape)}, not [N, D]: give LangSplat's own files.")
        return features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)


def _array(path: Path) -> np.ndarray:
    """Read a .npy file of numbers; raise ``UserError``."""
    try:
        array = load_array(path)
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read as an array ({reason(error)}): make it again.") from error
    if array.dtype.kind not in "biuf":
        raise UserError(f"{path} holds no array of numbers: give LangSplat's own files.")
    return array
