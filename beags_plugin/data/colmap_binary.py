"""COLMAP's binary files, walked through before they are read: what they promise must be in them."""

from __future__ import annotations

import math
import os
import struct
from pathlib import Path
from typing import BinaryIO

from beags_plugin.system.errors import UserError

_LONGEST_NAME = 4096
_PARAMETERS = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8, 5: 8, 6: 12, 7: 5, 8: 4, 9: 5, 10: 12}
"""Of camera models by COLMAP's id: how many parameters they have."""


def check_colmap_binary(file: Path) -> None:
    """Raise ``UserError`` unless images.bin, cameras.bin or points3D.bin is whole and holds finite numbers.

    A list whose length is a lie would make other readers ask for all the memory there is.
    """
    walk = {"images.bin": _image, "cameras.bin": _camera, "points3D.bin": _point}[file.name]
    try:
        with open(file, "rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            (count,) = _read(stream, "<Q")
            for _ in range(min(count, size)):  # every entry has bytes of its own
                walk(stream, size)
            if stream.tell() > size or count > size:
                raise ValueError("it is cut off")
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}): export the model again.") from error
    except ValueError as error:
        raise UserError(f"{file} is damaged ({error}): export the model again.") from error


def _read(stream: BinaryIO, form: str) -> tuple:
    content = stream.read(struct.calcsize(form))
    try:
        return struct.unpack(form, content)
    except struct.error:
        raise ValueError("it is cut off") from None


def _skip(stream: BinaryIO, count: int, each: int, size: int) -> None:
    """Go past a list; its end must lie in the file."""
    if count * each > size - stream.tell():
        raise ValueError(f"it promises a list of {count} entries and is cut off")
    stream.seek(count * each, os.SEEK_CUR)


def _image(stream: BinaryIO, size: int) -> None:
    image_id, *pose, _ = _read(stream, "<i7di")
    if not all(map(math.isfinite, pose)) or not any(pose[:4]):
        raise ValueError(f"the pose of image {image_id} is none")
    start = stream.tell()
    name, end, _ = stream.read(_LONGEST_NAME).partition(b"\0")
    if not end or not name:
        raise ValueError(f"image {image_id} has no name")
    try:
        name.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"the name of image {image_id} is no UTF-8") from None
    stream.seek(start + len(name) + 1)
    (points,) = _read(stream, "<Q")
    _skip(stream, points, 24, size)


def _camera(stream: BinaryIO, _: int) -> None:
    camera_id, model, width, height = _read(stream, "<iiQQ")
    if model not in _PARAMETERS:
        raise ValueError(f"camera {camera_id} is of the unknown model {model}")
    if not (0 < width <= 1 << 20 and 0 < height <= 1 << 20):
        raise ValueError(f"camera {camera_id} has {width} x {height} pixels")
    parameters = _read(stream, f"<{_PARAMETERS[model]}d")
    if not all(map(math.isfinite, parameters)) or not parameters[0] > 0:
        raise ValueError(f"camera {camera_id} has a focal length or lens that is none")


def _point(stream: BinaryIO, size: int) -> None:
    _, *place = _read(stream, "<Q3d3Bd")[:4]
    if not all(map(math.isfinite, place)):
        raise ValueError("it holds a point whose place is no number")
    (track,) = _read(stream, "<Q")
    _skip(stream, track, 8, size)
