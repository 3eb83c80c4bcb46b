"""Photos of a scene before they have poses: listing, checks, upright copies, and signs of blur and repetition."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from urllib.parse import quote

import numpy as np

from beags_plugin.data.files import IMAGE_SUFFIXES, folder_of_photos, image_size, list_photos, photo_names
from beags_plugin.system.digests import content_digest, value_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import Bar, counted
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.whole_files import write_whole

if TYPE_CHECKING:
    from PIL.Image import Image

FEWEST = 3  # photos that a scene needs
SIDE = 320
"""Longest side of the small grey pictures by which photos are compared, in pixels."""
SAME = 1.0
"""Mean difference of two small pictures, in grey levels, below which they are the same photo."""
BLURRED = 0.2
"""Share of the median sharpness of its ten neighbours below which a photo counts as blurred."""
_DIGITS = 16
_TURNED = 274  # EXIF's tag of the orientation
_LYING = (5, 6, 7, 8)  # orientations that swap width and height


@dataclass(frozen=True)
class Photo:
    """A photo of the scene: its source file, the scene's upright copy (or the same file), and what the header states.

    width, height: in pixels, upright. turned: whether the source is not upright. focal: in pixels, if EXIF states it.
    mask: id image of the objects on which features may lie; None for the whole photo. ignore_ids: ids of the mask that
    mean "unlabelled".
    """

    source: Path
    path: Path
    width: int
    height: int
    turned: bool
    focal: float | None
    digest: str
    mask: Path | None = None
    ignore_ids: tuple[int, ...] = ()

    @property
    def key(self) -> str:
        """Return the name in COLMAP's database, without spaces, which end a name in its lists of pairs."""
        return quote(self.path.name, safe="")


@dataclass(frozen=True)
class Look:
    """A photo reduced to ``SIDE``, [h, w] uint8, and its sharpness (variance of the Laplacian)."""

    small: np.ndarray
    sharpness: float


def find_photos(data: Path) -> list[Path]:
    """Return the photos of a folder, or of ``images`` in it, by name; raises ``UserError`` for too few."""
    folder, photos = folder_of_photos(data), list_photos(data)
    photo_names(photos)
    others = Counter(path.suffix.lower() for path in folder.iterdir() if path.is_file() and path not in set(photos))
    if heic := others[".heic"] + others[".heif"]:
        raise UserError(f"{folder} holds HEIC photos ({heic}): convert them to JPEG, which other programs read too.")
    if not photos:
        raise UserError(
            f"{folder} holds no photos: give --data a folder of {', '.join(IMAGE_SUFFIXES)} files, or a video."
        )
    if len(photos) < FEWEST:
        raise UserError(f"{folder} holds too few photos ({len(photos)}): give at least {FEWEST}, better 40.")
    return photos


def check_photos(paths: Sequence[Path], folder: Path, bar: Bar) -> list[Photo]:
    """Return the scene's photos, to be copied to ``folder``; raises ``UserError`` for photos that cannot be used."""
    with bar("photos") as progress:
        return [_checked(path, folder / path.name) for path in counted(paths, len(paths), progress)]


def _checked(source: Path, path: Path) -> Photo:
    import pycolmap

    def header(image: Image) -> tuple[str, int]:
        return image.mode, image.getexif().get(_TURNED, 1)

    width, height = image_size(source, "the photo")
    mode, turned = read_image(source, header, "the photo")
    if mode.startswith(("I", "F")):
        raise UserError(f"the photo {source} has more than 8 bits a channel: convert the photos to 8 bits.")
    if turned != 1 and source.resolve() == path.resolve():
        raise UserError(f"the photo {source} is stored on its side: give another --output-dir, for upright copies.")
    if turned in _LYING:
        width, height = height, width
    lens = pycolmap.infer_camera_from_image(source)
    focal = float(lens.mean_focal_length()) if lens.has_prior_focal_length else None
    return Photo(source, path, width, height, turned != 1, focal, content_digest([source])[:_DIGITS])


def with_masks(photos: Sequence[Photo], folder: Path, ignore_ids: tuple[int, ...] = ()) -> list[Photo]:
    """Return photos with their id images <stem>.png of a folder; raises ``UserError`` where these do not fit.

    ignore_ids: see ``Photo``.
    """
    masked = []
    for photo in photos:
        mask = folder / f"{photo.path.stem}.png"
        if not mask.is_file():
            masked.append(photo)
            continue
        if photo.turned:
            raise UserError(
                f"the photo {photo.source} is stored on its side, which its mask may be or not: make masks of the "
                "upright copies that beags process writes without --masks, and give their folder as --data."
            )
        if (size := image_size(mask, "the mask")) != (photo.width, photo.height):
            raise UserError(
                f"the mask {mask} is {size[0]}x{size[1]} pixels but its photo {photo.width}x{photo.height}: make it "
                "from the photo as it is."
            )
        content = content_digest([photo.source, mask])
        digest = (value_digest([content, *ignore_ids]) if ignore_ids else content)[:_DIGITS]
        masked.append(replace(photo, mask=mask, ignore_ids=ignore_ids, digest=digest))
    if not any(photo.mask for photo in masked):
        raise UserError(
            f"no mask in {folder} has the name of a photo ({photos[0].path.stem}.png, ...): correct --masks."
        )
    return masked


def copy_photos(photos: Sequence[Photo], bar: Bar) -> None:
    """Write upright copies of the photos that the scene lacks."""
    from PIL import Image, ImageOps

    if not (missing := [photo for photo in photos if not photo.path.exists()]):
        return
    kinds = Image.registered_extensions()

    def copy(photo: Photo, file: BinaryIO) -> None:
        if photo.turned:
            image = read_image(photo.source, ImageOps.exif_transpose, "the photo")
            image.save(file, kinds[photo.path.suffix.lower()], quality=95, exif=image.getexif())
        else:
            file.write(photo.source.read_bytes())

    with bar("copies") as progress:
        for photo in counted(missing, len(missing), progress):
            write_whole(photo.path, partial(copy, photo))


def look_at(grey: np.ndarray) -> Look:
    """Return the look of a grey photo [H, W] uint8."""
    import cv2

    factor = SIDE / max(grey.shape)
    size = [max(1, round(side * factor)) for side in grey.shape[::-1]]
    small = cv2.resize(grey, size, interpolation=cv2.INTER_AREA) if factor < 1 else grey
    return Look(small, float(cv2.Laplacian(small, cv2.CV_32F).var()))


def blurred(looks: Sequence[Look]) -> list[int]:
    """Return the indices of photos far less sharp than their neighbours in the order of names."""
    sharp = np.array([look.sharpness for look in looks])
    around = [np.median(sharp[max(0, index - 5) : index + 6]) for index in range(len(sharp))]
    return np.flatnonzero(sharp < BLURRED * np.array(around)).tolist()


def repeated(looks: Sequence[Look]) -> list[int]:
    """Return the indices of photos that show the same as an earlier one."""
    shapes: dict[tuple[int, ...], list[int]] = {}
    repeats = []
    for index, look in enumerate(looks):
        earlier = shapes.setdefault(look.small.shape, [])
        small = look.small.astype(np.int16)
        if any(np.abs(small - looks[other].small).mean() < SAME for other in earlier):
            repeats.append(index)
        else:
            earlier.append(index)
    return repeats
