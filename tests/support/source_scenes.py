"""Scenes for mask sources: photos, the maps that are to come of them, and a wall seen from three places."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from data_folders import HEIGHT, WIDTH, write_image
from PIL import Image

from beags_plugin.core.cameras import Camera
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


class Wall:
    """Three cameras side by side before a wall at depth 2: what one sees at x another sees ``shift`` pixels farther."""

    def __init__(self, root: Path, known: int = 3) -> None:
        self.photos, self.discs = [], []
        for index in range(3):
            photo, disc = coloured(left=30 + 10 * index)
            path = root / f"images/v{index}.png"
            write_image(path, photo)
            self.photos.append(Photo(path.stem, path, 90, 70))
            self.discs.append(disc)
        self.images = [photo.path for photo in self.photos[:known]]
        K = torch.tensor([[100.0, 0, 45], [0, 100.0, 35], [0, 0, 1]])
        self.cameras = []
        for index in range(known):
            viewmat = torch.eye(4)
            viewmat[0, 3] = 0.2 * index  # 10 pixels at depth 2
            self.cameras.append(Camera(viewmat, K, 90, 70))

    def depth(self, view: int) -> torch.Tensor:
        return torch.full((70, 90), 2.0)

    def to_straight(self, class_map: np.ndarray, view: int) -> np.ndarray:
        return class_map

    def to_photo(self, class_map: np.ndarray, view: int) -> np.ndarray:
        return class_map
