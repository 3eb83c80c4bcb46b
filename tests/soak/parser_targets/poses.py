"""Parsers of poses: tables in .npy, COLMAP's binary files, transforms.json."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np

from parser_targets.target import SIDE, Target, as_json, pictures


def _poses_bounds(path: Path) -> None:
    from beags_plugin.data.poses_bounds import read_poses_bounds

    read_poses_bounds(path, pictures())


def _colmap(path: Path) -> object:
    from beags_plugin.views.colmap_files import read_colmap_points
    from beags_plugin.views.colmap_model import read_cameras, read_images

    return {"points3D": read_colmap_points, "cameras": read_cameras, "images": read_images}[path.name.split(".")[0]](
        path
    )


def _transforms(path: Path) -> None:
    from beags_plugin.data.dataset import TransformsFile
    from beags_plugin.views.cameras import check_cameras
    from beags_plugin.views.data_options import DataOptions
    from beags_plugin.views.poses import read_poses

    pictures()
    views = read_poses(TransformsFile(path), path.parent, DataOptions())
    check_cameras(views.cameras, views.images)


def _npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _bounds_files() -> list[bytes]:
    row = np.concatenate([np.c_[np.eye(3), np.zeros(3), [SIDE, SIDE, 5.0]].ravel(), [1.0, 4.0]])
    return [_npy(np.stack([row] * 3)), _npy(np.stack([row] * 3).astype(np.float32))]


def _image_files() -> list[bytes]:
    rest = (
        struct.pack("<i7di", 1, 1, 0, 0, 0, 0, 0, 0, 1)
        + b"a.png\0"
        + struct.pack("<Q", 1)
        + struct.pack("<2dq", 1, 1, 1)
    )
    return [struct.pack("<Q", 1) + rest, struct.pack("<Q", 0)]


def _camera_files() -> list[bytes]:
    return [struct.pack("<Q", 1) + struct.pack("<iiQQ4d", 1, 1, SIDE, SIDE, 5, 5, 3, 3)]


def _point_files() -> list[bytes]:
    return [struct.pack("<Q", 1) + struct.pack("<Q3d3BdQ", 1, 0, 0, 0, 1, 2, 3, 0.5, 1) + struct.pack("<ii", 1, 1)]


def _transforms_files() -> list[bytes]:
    poses = [np.c_[np.eye(4)[:, :3], [0.3 * index, 0.1, index, 1.0]].tolist() for index in range(3)]
    frames = [{"file_path": f"images/{name}.png", "transform_matrix": poses[i]} for i, name in enumerate("abc")]
    meta = {"fl_x": 5.0, "fl_y": 5.0, "cx": 3.0, "cy": 3.0, "w": SIDE, "h": SIDE, "camera_model": "OPENCV"}
    more = {"k1": 0.1, "train_filenames": ["images/a.png"], "val_filenames": ["images/b.png"], "applied_scale": 1.0}
    return [
        as_json({**meta, "frames": frames}),
        as_json({**meta, **more, "frames": [{**frames[0], **meta}, frames[1]]}),
    ]


TARGETS = {
    "npy poses": Target("poses_bounds.npy", _poses_bounds, _bounds_files),
    "colmap images": Target("images.bin", _colmap, _image_files),
    "colmap cameras": Target("cameras.bin", _colmap, _camera_files),
    "colmap points": Target("points3D.bin", _colmap, _point_files),
    "transforms.json": Target("transforms.json", _transforms, _transforms_files),
}
