"""Masks of LLFF's scenes that are downloaded separately from the photos: NVOS and SPIn-NeRF."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beags_plugin.data.files import image_size, list_images
from beags_plugin.labels.classes import read_object_mask
from beags_plugin.system.errors import UserError

POINTS = 10  # most points of each kind that replace the scribbles on an object, about as many as a user clicks
_MASK = "_mask"
_NO_MASKS = ("_pseudo", "_cutout")  # endings of other pictures among SPIn-NeRF's masks


@dataclass(frozen=True)
class Scribbles:
    """Scribbles on an object in one view, as points.

    view: stem of the camera's file. size: (width, height) of the image that the points refer to. inside, outside:
    (x, y), pixels, on the object and beside it.
    """

    view: str
    size: tuple[int, int]
    inside: tuple[tuple[float, float], ...]
    outside: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class DownloadedObject:
    """An object with its visible masks by the stem of the camera's file, and its scribbles if there are any."""

    name: str
    masks: dict[str, Path]
    scribbles: Scribbles | None = None


def read_nvos(folder: Path, scene: str) -> list[DownloadedObject]:
    """Read NVOS's objects of a scene of LLFF.

    folder: holds masks/<object>/<photo>_mask.png, scribbles/<object>/pos_*.png and neg_*.png (of any size in the
    photo's proportions), and reference_image/<object>/<photo>, the photo with the scribbles. An object's name is that
    of the scene, perhaps with an ending (horns_left). Raises ``UserError`` without masks, and for incomplete scribbles.
    """
    masks = folder / "masks"
    if not masks.is_dir():
        raise UserError(f"{folder} has no folder masks: give --nvos the folder that holds masks and scribbles.")
    names = sorted(path.name for path in masks.iterdir() if path.is_dir())
    own = [name for name in names if name == scene or name.startswith(f"{scene}_")]
    if not own:
        raise UserError(f"{masks} has no object of a scene {scene!r}: name one of {', '.join(names)} with --scene.")
    objects = []
    for name in own:
        files = {path.stem.removesuffix(_MASK): path for path in sorted((masks / name).glob(f"*{_MASK}.png"))}
        if not files:
            raise UserError(f"{masks / name} holds no mask <photo>{_MASK}.png: restore the download.")
        objects.append(DownloadedObject(name, files, _scribbles(folder, name)))
    return objects


def read_spin_nerf(folder: Path, scene: str, name: str) -> list[DownloadedObject]:
    """Read SPIn-NeRF's masks of a scene, as masks of the object ``name``.

    folder: holds <scene>/<photo>.png, or is <scene> itself. Raises ``UserError`` without masks.
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
    """Yield at most ``POINTS`` points (x, y) along the middle of scribbles, each as far as possible from the others.

    Points are in pixels from the corner of the image. The first is where the scribbles are broadest.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter

    if not files:
        return
    scribbled = np.stack([read_object_mask(path) == 1 for path in files]).any(axis=0)
    depth = np.asarray(distance_transform_edt(np.pad(scribbled, 1)))[1:-1, 1:-1]  # scribbles end at the image's border
    rows, columns = np.nonzero(scribbled & (depth == maximum_filter(depth, 3)))  # the middle line
    if not len(rows):
        return
    places = np.stack([columns, rows], axis=1) + 0.5
    distance = np.full(len(places), np.inf)  # squared, to the points so far
    chosen = int(np.argmax(depth[rows, columns]))
    for _ in range(min(POINTS, len(places))):
        x, y = places[chosen]
        yield float(x), float(y)
        distance = np.minimum(distance, ((places - places[chosen]) ** 2).sum(axis=1))
        chosen = int(np.argmax(distance))
