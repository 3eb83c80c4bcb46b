"""Scenes for mask sources: photos, and the maps that are to come of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from data_folders import HEIGHT, WIDTH, write_image
from PIL import Image

from beags_plugin.masks.sources.base import MadeMasks, Photo, SourceScene


def scene_of(root: Path, count: int = 4) -> SourceScene:
    photos = []
    for index in range(count):
        path = root / f"images/v{index}.png"
        write_image(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        photos.append(Photo(path.stem, path, WIDTH, HEIGHT))
    return SourceScene(root, photos)


def truth(index: int) -> np.ndarray:
    ids = np.zeros((HEIGHT, WIDTH), np.uint8)
    ids[2:8, 1 + index : 7 + index], ids[5:11, 10:16] = 1, 2
    return ids


def maps_of(made: MadeMasks) -> list[np.ndarray | None]:
    return list(made.maps)


def make(source, scene) -> tuple[dict[int, str], list[np.ndarray | None]]:
    made = source.make(scene, lambda done, total: None)
    return dict(made.names), maps_of(made)


def scene_of_folders(root: Path, names=("left/v0", "left/v1", "right/v0", "right/v2")) -> SourceScene:
    """Write photos of two cameras; v0 is the stem of two."""
    photos = []
    for name in names:
        path = root / f"images/{name}.png"
        write_image(path, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
        photos.append(Photo(name, path, WIDTH, HEIGHT))
    return SourceScene(root, photos)


def mask_at(path: Path, value: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((HEIGHT, WIDTH), value, np.uint8)).save(path)


def values_of(maps) -> list[int | None]:
    return [None if class_map is None else int(class_map.max()) for class_map in maps]


def coloured(width: int = 90, height: int = 70, left: int = 30) -> tuple[np.ndarray, np.ndarray]:
    """Return a photo of a red disc on a textured grey ground, and the disc's mask."""
    generator = np.random.default_rng(left)
    row, column = np.mgrid[:height, :width] + 0.5
    disc = (row - 35) ** 2 + (column - left) ** 2 < 15**2
    photo = np.where(disc[..., None], (190, 50, 40), (110, 120, 115)) + generator.integers(-12, 12, (height, width, 3))
    return photo.astype(np.uint8), disc
