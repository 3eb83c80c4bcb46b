"""COLMAP's models on disk, text and binary: cameras and images, in double precision.

Counts in binary files are checked before memory of that size is allocated.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from beags_plugin.data.files import IMAGE_SUFFIXES
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.stand_ins import stand_in
from beags_plugin.system.reading.text import read_text, reason

Content = TypeVar("Content")
_IMAGE = struct.Struct("<i7di")  # id, rotation wxyz, translation, id of the camera; a name and its features follow
_FEATURE = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_NAMED = re.compile(rf"^\d+(?:\s+\S+){{7}}\s+\d+\s+\S.*({'|'.join(map(re.escape, IMAGE_SUFFIXES))})$", re.IGNORECASE)


_CAMERA = struct.Struct("<iiQQ")  # id, number of the model, width and height; the parameters follow as doubles
_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""COLMAP's camera models in the order of their numbers, with their numbers of parameters."""


@dataclass(frozen=True)
class ColmapCamera:
    """A camera of a model: COLMAP's name of its lens, its size in pixels, and the lens's parameters [P] float64."""

    model: str
    width: int
    height: int
    params: np.ndarray


@dataclass(frozen=True)
class ColmapImage:
    """An image of a model: name as COLMAP wrote it, world-to-camera rotation wxyz [4] and translation [3], OpenCV.

    xys: [N, 2] float64, pixels of its features; points: [N] int64, ids of their points, negative without one.
    """

    name: str
    quaternion: np.ndarray
    translation: np.ndarray
    camera: int
    xys: np.ndarray
    points: np.ndarray


def model_files(folder: Path) -> tuple[Path, Path]:
    """Return the files of cameras and images of a complete model; text takes precedence, as in nerfstudio."""
    end = "txt" if (folder / "cameras.txt").is_file() else "bin"
    return folder / f"cameras.{end}", folder / f"images.{end}"


def read_cameras(file: Path) -> dict[int, ColmapCamera]:
    """Read cameras.bin or cameras.txt, by id; raise ``UserError``."""
    return read(_cameras_text if file.suffix == ".txt" else _cameras_binary, file)


def read_images(file: Path) -> list[ColmapImage]:
    """Read images.bin or images.txt in the order of ids; raise ``UserError``."""
    images = read(_images_text if file.suffix == ".txt" else _images_binary, file)
    return [images[index] for index in sorted(images)]


def read(reader: Callable[[Path], Content], file: Path) -> Content:
    """Apply ``reader`` to a file of a model; any error becomes a ``UserError``."""
    try:
        return reader(file)
    except UserError:
        raise
    except Exception as error:  # such as struct.error and IndexError
        if (cause := stand_in(file)) is not None:
            raise UserError(f"{file} cannot be read: {cause}.") from error
        if isinstance(error, struct.error):
            raise UserError(f"{file} cannot be read (the file is cut off): export the model again.") from error
        raise UserError(
            f"{file} cannot be read ({type(error).__name__}: {reason(error)}): export the model again."
        ) from error


def lines_of(file: Path) -> Iterator[str]:
    """Yield the lines of a text file of a model without comments, with the line ends of any system."""
    try:
        text = read_text(file)
    except UnicodeDecodeError:  # Windows writes names in its own code page
        text = _decoded(file.read_bytes())
    lines = re.split(r"\r\n|\n|\r", text)  # splitlines would also split at characters in names
    return (line for line in lines if not line.lstrip().startswith("#"))


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a quaternion wxyz [4]."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * y**2 - 2 * z**2, 2 * x * y - 2 * w * z, 2 * z * x + 2 * w * y],
            [2 * x * y + 2 * w * z, 1 - 2 * x**2 - 2 * z**2, 2 * y * z - 2 * w * x],
            [2 * z * x - 2 * w * y, 2 * y * z + 2 * w * x, 1 - 2 * x**2 - 2 * y**2],
        ]
    )


def _cameras_binary(file: Path) -> dict[int, ColmapCamera]:
    content, at = file.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", content)
    names, cameras = list(_PARAMETERS), {}
    for _ in range(count):
        camera_id, number, width, height = _CAMERA.unpack_from(content, at)
        if not 0 <= number < len(names):
            raise KeyError(number)
        params = struct.unpack_from(f"<{_PARAMETERS[names[number]]}d", content, at + _CAMERA.size)
        at += _CAMERA.size + 8 * len(params)
        cameras[camera_id] = ColmapCamera(names[number], width, height, np.array(params))
    assert len(cameras) == count
    return cameras


def _cameras_text(file: Path) -> dict[int, ColmapCamera]:
    cameras = {}
    for line in lines_of(file):
        if words := line.split():
            params = np.array([float(word) for word in words[4:]])
            cameras[int(words[0])] = ColmapCamera(words[1], int(words[2]), int(words[3]), params)
    return cameras


def _images_text(file: Path) -> dict[int, ColmapImage]:
    """Read images.txt. The name is the rest of its line; the line of features may be empty or missing."""
    images, lines = {}, list(lines_of(file))
    at = 0
    while at < len(lines):
        words = lines[at].split(maxsplit=9)
        at += 1
        if not words:
            continue
        if len(words) < 10:
            raise ValueError(f"the line {lines[at - 1]!r:.60} is no image: id, rotation, translation, camera, name")
        features: list[str] = []
        if at < len(lines) and _NAMED.match(lines[at].strip()) is None:
            features = lines[at].split()
            at += 1
        if len(features) % 3:
            raise ValueError(f"the features of {words[9]} are no triples of x, y and a point's id")
        table = np.array(features, np.float64).reshape(-1, 3)
        images[int(words[0])] = ColmapImage(
            words[9].strip(), np.array(words[1:5], np.float64), np.array(words[5:8], np.float64), int(words[8]),
            table[:, :2], np.array([_point_id(word) for word in features[2::3]], np.int64),
        )  # fmt: skip
    return images


def _point_id(word: str) -> int:
    """Return the id of a point, -1 for none, which some programs write as an unsigned number."""
    return -1 if (point := int(word)) >= 1 << 63 else point


def _images_binary(file: Path) -> dict[int, ColmapImage]:
    content, at = file.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", content)
    images = {}
    for _ in range(count):
        image_id, *values, camera = _IMAGE.unpack_from(content, at)
        end = content.index(b"\0", at + _IMAGE.size)
        name = _decoded(content[at + _IMAGE.size : end])
        (length,) = struct.unpack_from("<Q", content, end + 1)
        at = end + 9
        if at + length * _FEATURE.itemsize > len(content):
            raise struct.error
        table = np.frombuffer(content, _FEATURE, length, at)
        at += length * _FEATURE.itemsize
        images[image_id] = ColmapImage(
            name, np.array(values[:4]), np.array(values[4:]), camera, table["xy"], table["point"]
        )
    return images


def _decoded(name: bytes) -> str:
    """Decode a name from UTF-8, else from Windows' code page."""
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError:
        return name.decode("cp1252", "replace")
