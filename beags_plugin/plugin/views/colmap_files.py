"""Single files of a COLMAP model, for poses that come from elsewhere."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.utils import colmap_parsing_utils as colmap
from nerfstudio.process_data.colmap_utils import parse_colmap_camera_params
from torch import Tensor

from beags_plugin.system.errors import UserError

_POINT = struct.Struct("<QdddBBBdQ")  # id, position, colour, error, length of the track


def read_lens(file: Path, size: Sequence[int], focal: float) -> Tensor:
    """Read the lens distortion k1, k2, k3, k4, p1, p2 [6] float32 of the only camera in cameras.bin or cameras.txt.

    size, focal: width, height and focal length in pixels of the expected camera. Zeros if the file has another one,
    several, or one without such a lens. Raises ``UserError`` if it cannot be read.
    """
    readers = {".bin": colmap.read_cameras_binary, ".txt": colmap.read_cameras_text}
    cameras = _read(readers[file.suffix], file)
    if len(cameras) != 1:
        return torch.zeros(6)
    try:
        camera = parse_colmap_camera_params(next(iter(cameras.values())))
    except NotImplementedError:
        return torch.zeros(6)
    same = (camera["w"], camera["h"]) == tuple(size) and abs(camera["fl_x"] - focal) < 1e-3 * focal
    if not same or camera["camera_model"] != "OPENCV":
        return torch.zeros(6)
    return torch.tensor([float(camera.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4", "p1", "p2")])


def read_colmap_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [N, 3] float32 and colours [N, 3] uint8 of points3D.bin or points3D.txt."""
    readers = {".bin": _binary_points, ".txt": colmap.read_points3D_text}
    points = _read(readers[file.suffix], file).values()
    xyz = np.array([point.xyz for point in points], np.float32).reshape(-1, 3)
    return xyz, np.array([point.rgb for point in points], np.uint8).reshape(-1, 3)


def read_features(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Read the features of each image of a complete model, by the image's name without suffix.

    Returns ids of their points [N] int64, -1 where the model has none, and places [N, 2] float64 in 0..1, from the left
    and the top of the image. Raises ``UserError`` if a file cannot be read.
    """
    text = (folder / "cameras.txt").is_file()  # the order in which nerfstudio looks
    end, camera_reader, image_reader = (
        ("txt", colmap.read_cameras_text, colmap.read_images_text)
        if text
        else ("bin", colmap.read_cameras_binary, colmap.read_images_binary)
    )
    cameras, images = _read(camera_reader, folder / f"cameras.{end}"), folder / f"images.{end}"

    def features(file: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        found = {}
        for image in image_reader(file).values():
            camera, ids = cameras[image.camera_id], np.asarray(image.point3D_ids, np.int64)
            places = np.reshape(image.xys, (-1, 2)) / [camera.width, camera.height]
            found[Path(image.name).with_suffix("").as_posix()] = np.maximum(ids, -1), places
        return found

    return _read(features, images)


@dataclass(frozen=True)
class _Point:
    xyz: Sequence[float]
    rgb: Sequence[int]


def _binary_points(file: Path) -> dict[int, _Point]:
    """Read points3D.bin by id; nerfstudio's reader takes all memory where the length of a track is damaged."""
    content, offset = file.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", content)
    points = {}
    for _ in range(count):
        if offset + _POINT.size > len(content):
            raise ValueError("the file is cut off")
        point_id, *values, length = _POINT.unpack_from(content, offset)
        points[point_id] = _Point(values[:3], values[3:6])
        offset += _POINT.size + 8 * length  # its track follows
    return points


def _read(reader: Callable[[Any], dict], file: Path) -> dict:
    try:
        return reader(file)
    # the readers let struct.error, IndexError and the like through
    except Exception as error:
        raise UserError(f"{file} cannot be read ({type(error).__name__}: {error}): export the model again.") from error
