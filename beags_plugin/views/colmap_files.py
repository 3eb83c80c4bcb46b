"""Lenses, points and features of a COLMAP model, for poses, seed points and tracks."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.data.frame_cameras import LENS, FrameCamera
from beags_plugin.data.photo_files import plain_name, without_suffix
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.colors import GREY, as_bytes
from beags_plugin.system.reading.text import number_of
from beags_plugin.views.colmap_model import ColmapCamera, lines_of, model_files, read, read_cameras, read_images

_LENSES = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
"""COLMAP's camera models that are supported, with their parameters in order."""
_POINT = struct.Struct("<QdddBBBdQ")  # id, position, colour, error, length of the track


def read_lens(file: Path, size: Sequence[int], focal: float) -> Tensor:
    """Read the lens distortion k1, k2, k3, k4, p1, p2 [6] float32 of the only camera in cameras.bin or cameras.txt.

    size, focal: width, height and focal length in pixels of the expected camera. Returns zeros if the file has another
    camera, several, or one without such a lens. Raises ``UserError`` if it cannot be read.
    """
    cameras = read_cameras(file)
    if len(cameras) != 1:
        return torch.zeros(6)
    camera = _frame_camera(next(iter(cameras.values())))
    if camera is None or camera.model != "OPENCV":
        return torch.zeros(6)
    same = (camera.width, camera.height) == tuple(size) and abs(camera.fx - focal) < 1e-3 * focal
    return torch.tensor(camera.lens) if same else torch.zeros(6)


def colmap_cameras(file: Path) -> dict[int, FrameCamera]:
    """Read the cameras of a model by id; raise ``UserError`` for a lens that is not supported."""
    cameras = {}
    for index, camera in read_cameras(file).items():
        if camera.model not in _LENSES:
            raise UserError(
                f"the camera {index} of {file} has COLMAP's lens {camera.model}, which is not supported: undistort "
                "the images with colmap image_undistorter and give that folder."
            )
        if (entry := _frame_camera(camera)) is None:
            raise UserError(f"the camera {index} of {file} lacks parameters: export the model again.")
        cameras[index] = entry
    return cameras


def _frame_camera(camera: ColmapCamera) -> FrameCamera | None:
    """Convert a camera of a model; return None for a lens that is not supported, or too few parameters."""
    names = _LENSES.get(camera.model)
    if names is None or len(camera.params) < len(names):
        return None
    values = dict(zip(names, map(float, camera.params), strict=False))
    fx = values.get("f", values.get("fx", 0.0))
    kind = "OPENCV_FISHEYE" if camera.model.endswith("FISHEYE") else "OPENCV"
    lens = tuple(values.get(name, 0.0) for name in LENS)
    return FrameCamera(
        fx, values.get("fy", fx), values["cx"], values["cy"], camera.width, camera.height, lens, kind
    )  # fmt: skip


def read_colmap_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read positions [N, 3] float64 and colours [N, 3] uint8 of points3D.bin or points3D.txt."""
    return read(_text_points if file.suffix == ".txt" else _binary_points, file)


def read_features(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Read the features of each image of a complete model, by the image's name without suffix.

    Returns the ids of their points [N] int64, -1 for a feature without a point, and their places [N, 2] float64, shares
    of width and height from the left and the top. Raises ``UserError`` if a file cannot be read.
    """
    cameras_file, images_file = model_files(folder)
    cameras, features = read_cameras(cameras_file), {}
    for image in read_images(images_file):
        if (camera := cameras.get(image.camera)) is None:
            raise UserError(f"{images_file} names the camera {image.camera}, which {cameras_file} lacks: export again.")
        places = image.xys / [camera.width, camera.height]
        features[without_suffix(plain_name(image.name))] = np.maximum(image.points, -1), places
    return features


def _text_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split(maxsplit=7)[:7] for line in lines_of(file) if line.strip()]
    if short := next((row for row in rows if len(row) not in (4, 7)), None):
        raise ValueError(f"the line {' '.join(short)!r:.60} is no point: id, x, y, z, red, green, blue")
    by_id = {int(row[0]): [number_of(word) for word in row[1:]] + [GREY] * (7 - len(row)) for row in rows}
    table = np.array(list(by_id.values()), np.float64).reshape(-1, 6)
    colors = table[:, 3:]
    if len(colors) and (colors == np.round(colors)).all() and colors.max() < 1 << 31:
        colors = colors.astype(np.int32)  # other colours are shares of 1
    return table[:, :3].copy(), as_bytes(colors)


def _binary_points(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Read points3D.bin; nerfstudio's reader exhausts memory if the length of a track is damaged."""
    content, offset = file.read_bytes(), 8
    (count,) = struct.unpack_from("<Q", content)
    points: dict[int, tuple[float, ...]] = {}
    for _ in range(count):
        if offset + _POINT.size > len(content):
            raise struct.error
        point_id, *values, length = _POINT.unpack_from(content, offset)
        points[point_id] = tuple(values[:6])
        offset += _POINT.size + 8 * length  # its track follows
    table = np.array(list(points.values()), np.float64).reshape(-1, 6)
    return table[:, :3].copy(), table[:, 3:].astype(np.uint8)
