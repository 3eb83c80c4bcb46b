"""Masks of LLFF's scenes that are downloaded apart from the photos: NVOS and SPIn-NeRF."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beags_plugin.data.files import image_size, list_images
from beags_plugin.labels.classes import read_binary_mask
from beags_plugin.system.errors import UserError

POINTS = 10  # of each kind that stand for the scribbles on an object, as many as one would click
_MASK = "_mask"
_NO_MASKS = ("_pseudo", "_cutout")  # beside SPIn-NeRF's masks lie pictures under these names


@dataclass(frozen=True)
class Scribbles:
    """Scribbles on an object in one view, as points. view: stem of the camera's file. size: (width, height) that the
    points are pixels of. inside, outside: (x, y), on the object and beside it."""

    view: str
    size: tuple[int, int]
    inside: tuple[tuple[float, float], ...]
    outside: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class DownloadedObject:
    """An object with its visible masks, by the stem of the camera's file, and its scribbles if they are there."""

    name: str
    masks: dict[str, Path]
    scribbles: Scribbles | None = None


def read_nvos(folder: Path, scene: str) -> list[DownloadedObject]:
    """Read NVOS's objects of a scene of LLFF.

    folder: holds masks/<object>/<photo>_mask.png, scribbles/<object>/pos_*.png and neg_*.png (of any size in the
    photo's proportions), and reference_image/<object>/<photo>, the photo that these are on. Objects are called as the
    scene, or as the scene and more (horns_left). Raises ``UserError`` without masks, and for a part of the scribbles.
    """
    masks = folder / "masks"
    if not masks.is_dir():
        raise UserError(f"{folder} has no folder masks: give --nvos the folder that holds masks and scribbles.")
    names = sorted(path.name for path in masks.iterdir() if path.is_dir())
    own = [name for name in names if name == scene or name.startswith(f"{scene}_")]
    if not own:
        raise UserError(f"{masks} has no object of a scene {scene!r}: name one of {', '.join(names)} with --scene.")
    found = []
    for name in own:
        files = {path.stem.removesuffix(_MASK): path for path in sorted((masks / name).glob(f"*{_MASK}.png"))}
        if not files:
            raise UserError(f"{masks / name} holds no mask <photo>{_MASK}.png: restore the download.")
        found.append(DownloadedObject(name, files, _scribbles(folder, name)))
    return found


def read_spin_nerf(folder: Path, scene: str, name: str) -> list[DownloadedObject]:
    """Read SPIn-NeRF's masks of a scene as those of the object ``name``.

    folder: holds <scene>/<photo>.png, or is that folder. Raises ``UserError`` without masks.
    """
    own = folder / scene if (folder / scene).is_dir() else folder
    files = {path.stem: path for path in sorted(own.glob("*.png")) if not path.stem.endswith(_NO_MASKS)}
    if not files:
        raise UserError(f"{own} holds no mask <photo>.png: give --spin-nerf the folder of the masks of all scenes.")
    return [DownloadedObject(name, files)]


def _scribbles(folder: Path, name: str) -> Scribbles | None:
    """Return an object's scribbles; None if the download lacks them."""
    strokes, photos = folder / "scribbles" / name, list_images(folder / "reference_image" / name)
    inside, outside = (sorted(strokes.glob(f"{kind}_*.png")) for kind in ("pos", "neg"))
    if not inside or not photos:
        return None
    if len(photos) > 1:
        raise UserError(f"{photos[0].parent} holds {len(photos)} photos: keep the one that the scribbles are on.")
    sizes = {image_size(path, "the scribble") for path in (*inside, *outside)}
    if len(sizes) > 1:
        raise UserError(f"the scribbles in {strokes} differ in size: restore the download.")
    return Scribbles(photos[0].stem, sizes.pop(), tuple(points_of(inside)), tuple(points_of(outside)))


def points_of(files: list[Path]) -> Iterator[tuple[float, float]]:
    """Yield at most ``POINTS`` points (x, y) along the middle of scribbles, each far from those before it.

    Points are pixels, with the corner of the image as origin. The first is where the scribbles are broadest.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter

    if not files:
        return
    drawn = np.stack([read_binary_mask(path) for path in files]).any(axis=0)
    depth = np.asarray(distance_transform_edt(np.pad(drawn, 1)))[1:-1, 1:-1]  # the image ends at its border
    rows, columns = np.nonzero(drawn & (depth == maximum_filter(depth, 3)))  # the middle line
    if not len(rows):
        return
    places = np.stack([columns, rows], axis=1) + 0.5
    left = np.full(len(places), np.inf)
    chosen = int(np.argmax(depth[rows, columns]))
    for _ in range(min(POINTS, len(places))):
        x, y = places[chosen]
        yield float(x), float(y)
        left = np.minimum(left, ((places - places[chosen]) ** 2).sum(axis=1))
        chosen = int(np.argmax(left))
