"""Photos stored turned, with an EXIF orientation: conversion of images and masks, and messages."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import quoted
from beags_plugin.system.reading.images import read_image
from beags_plugin.system.wording import amount

TAG = 274  # EXIF's tag of the orientation
LYING = (5, 6, 7, 8)  # its values that swap width and height


def orientation(path: Path) -> int:
    """Return EXIF's orientation of a photo, 1 (upright) to 8; 1 without one, and for a photo that cannot be read."""
    try:
        value = read_image(path, lambda image: image.getexif().get(TAG, 1))
    except (UserError, FileNotFoundError):
        return 1
    return value if value in range(1, 9) else 1


def upright(image: np.ndarray, turned: int) -> np.ndarray:
    """Turn an image [H, W, ...] stored with EXIF's orientation ``turned`` upright."""
    return _turned(image, turned, -1)


def as_stored(image: np.ndarray, turned: int) -> np.ndarray:
    """Undo ``upright``."""
    return _turned(image, turned, 1)


def _turned(image: np.ndarray, turned: int, quarter: int) -> np.ndarray:
    view = {
        1: lambda: image,
        2: lambda: image[:, ::-1],
        3: lambda: image[::-1, ::-1],
        4: lambda: image[::-1],
        5: lambda: image.swapaxes(0, 1),
        6: lambda: np.rot90(image, quarter),
        7: lambda: image[::-1, ::-1].swapaxes(0, 1),
        8: lambda: np.rot90(image, -quarter),
    }[turned]()
    return np.ascontiguousarray(view)


def upright_mask_error(mask: Path | str, size: tuple[int, int], photo: Path, photo_size: tuple[int, int]) -> str | None:
    """Return a sentence on a mask whose sides are those of its photo swapped; None unless EXIF turns the photo.

    mask: its file, or words for it. size, photo_size: (width, height), the photo's as it is stored.
    """
    if size != photo_size[::-1] or size == photo_size or (turned := orientation(photo)) not in LYING:
        return None
    folder = Path(mask).parent if isinstance(mask, Path) else "FOLDER"
    return (
        f"the mask {mask} is upright, {size[0]}x{size[1]} pixels, but its photo {photo} is stored on its side, "
        f"{photo_size[0]}x{photo_size[1]} with EXIF orientation {turned}: turn the masks with beags masks make "
        f"--upright --overwrite --source id-images --options folder={quoted(folder)} --data FOLDER."
    )


def sideways_photo_error(photo: Path, size: tuple[int, int], camera: tuple[int, int]) -> str | None:
    """Return a sentence on poses that were made from upright photos; None unless EXIF turns this photo."""
    if size == camera or size != camera[::-1] or (turned := orientation(photo)) not in LYING:
        return None
    return (
        f"the image {photo} is stored on its side, {size[0]}x{size[1]} pixels with EXIF orientation {turned}, but its "
        f"camera is upright, {camera[0]}x{camera[1]}: turn the photos, e.g. with exiftran -ai or mogrify -auto-orient, "
        "in a copy of their folder."
    )


def turned_note(photos: Sequence[Path]) -> str | None:
    """Return a sentence on photos that are stored turned and whose masks may be upright unnoticed; None without any.

    These are orientations that keep the photo's size: upside down, mirrored, or square photos on their side.
    """
    stored = []
    for photo in photos:
        turned = orientation(photo)
        if turned == 1:
            continue
        size = read_image(photo, lambda image: image.size)
        if turned not in LYING or size[0] == size[1]:
            stored.append((photo, turned))
    if not stored:
        return None
    photo, turned = stored[0]
    return (
        f"{amount(len(stored), 'photo', 'are')} stored turned (first {photo}, with EXIF orientation "
        f"{turned}): masks must lie as the photos are stored; turn upright ones with beags masks make --upright."
    )
