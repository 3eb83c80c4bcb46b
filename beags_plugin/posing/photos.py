"""The photos of a scene before they have poses: found, refused or copied upright, and looked at for what is wrong."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_plugin.data.files import IMAGE_SUFFIXES, list_images, photo_names
from beags_plugin.system.digests import content_digest
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import counted
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.whole_files import unfinished, write_whole

if TYPE_CHECKING:
    from PIL.Image import Image

FEWEST = 3  # photos
SIDE = 320
"""Longest side of the small grey pictures that photos are compared by, in pixels."""
SAME = 1.0
"""Grey levels: two small pictures that differ by less, in the mean, are one photo twice."""
BLURRED = 0.2
"""A photo is called blurred if its sharpness is below this share of the median of its ten neighbours."""
_DIGITS = 16
_TURNED = 274  # EXIF's tag of the orientation


@dataclass(frozen=True)
class Photo:
    """A photo in the folder of the scene: its file, size in pixels, and focal length in pixels if EXIF tells it."""

    path: Path
    width: int
    height: int
    focal: float | None
    digest: str


@dataclass(frozen=True)
class Look:
    """What a small picture tells: the picture [h, w] uint8, and its sharpness (variance of the Laplacian)."""

    small: np.ndarray
    sharpness: float


def find_photos(data: Path) -> list[Path]:
    """Return the photos of a folder, or of ``images`` in it, by name; raises ``UserError`` for too few or none."""
    folder = data if list_images(data) or not (data / "images").is_dir() else data / "images"
    found = list_images(folder)
    photo_names(found)
    others = Counter(path.suffix.lower() for path in folder.iterdir() if path.is_file() and path not in set(found))
    if heic := others[".heic"] + others[".heif"]:
        raise UserError(f"{folder} holds {heic} HEIC photos: convert them to JPEG, which other programs can read too.")
    if not found:
        raise UserError(
            f"{folder} holds no photos: give --data a folder of {', '.join(IMAGE_SUFFIXES)} files, or a video."
        )
    if len(found) < FEWEST:
        raise UserError(f"{folder} holds only {len(found)} photos: give at least {FEWEST}, better 40.")
    return found


def take_photos(found: Sequence[Path], folder: Path, progress: Callable[[int, int], None]) -> list[Photo]:
    """Copy photos into ``folder``, upright, unless they lie there already.

    Raises ``UserError`` for photos that cannot be used, before any is copied.
    """
    checked = [(path, read_image(path, lambda image, path=path: _checked(image, path), "the photo")) for path in found]
    return [_taken(path, folder / path.name, *header) for path, header in counted(checked, len(checked), progress)]


def _checked(image: Image, path: Path) -> tuple[int, int, int]:
    """Return width, height and EXIF's orientation."""
    if image.mode.startswith(("I", "F")):
        raise UserError(f"the photo {path} has more than 8 bits a channel: convert the photos to 8 bits.")
    return *image.size, image.getexif().get(_TURNED, 1)


def _taken(path: Path, target: Path, width: int, height: int, turned: int) -> Photo:
    import pycolmap
    from PIL import ImageOps

    if turned in (5, 6, 7, 8):
        width, height = height, width
    if turned != 1 and path.resolve() == target.resolve():
        raise UserError(f"the photo {path} is stored lying on its side: give another --output-dir for upright copies.")
    if turned != 1 and not target.exists():

        def upright(image: Image) -> Image:
            return ImageOps.exif_transpose(image)

        image = read_image(path, upright, "the photo")
        kind = {".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF"}.get(path.suffix.lower(), path.suffix[1:].upper())
        write_whole(target, lambda file: image.save(file, kind, quality=95))
    elif not target.exists():
        with writing(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            part = unfinished(target)
            shutil.copyfile(path, part)
            part.replace(target)
    lens = pycolmap.infer_camera_from_image(path)
    focal = float(lens.mean_focal_length()) if lens.has_prior_focal_length else None
    return Photo(target, width, height, focal, content_digest([path])[:_DIGITS])


def small_grey(photo: np.ndarray) -> np.ndarray:
    """Return a grey photo [H, W] uint8 reduced to ``SIDE``."""
    import cv2

    factor = SIDE / max(photo.shape)
    size = [max(1, round(side * factor)) for side in photo.shape[::-1]]
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA) if factor < 1 else photo


def look_at(grey: np.ndarray) -> Look:
    """Return what the small picture of a grey photo [H, W] uint8 tells."""
    import cv2

    small = small_grey(grey)
    return Look(small, float(cv2.Laplacian(small, cv2.CV_32F).var()))


def blurred(looks: Sequence[Look]) -> list[int]:
    """Return the photos that are far less sharp than those beside them in order."""
    sharp = np.array([look.sharpness for look in looks])
    around = [np.median(sharp[max(0, index - 5) : index + 6]) for index in range(len(sharp))]
    return np.flatnonzero(sharp < BLURRED * np.array(around)).tolist()


def repeated(looks: Sequence[Look]) -> list[int]:
    """Return the photos that show the same as an earlier one."""
    shapes: dict[tuple[int, ...], list[int]] = {}
    found = []
    for index, look in enumerate(looks):
        kept = shapes.setdefault(look.small.shape, [])
        small = look.small.astype(np.int16)
        if any(np.abs(small - looks[other].small).mean() < SAME for other in kept):
            found.append(index)
        else:
            kept.append(index)
    return found
