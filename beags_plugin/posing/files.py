"""The posed scene on disk: transforms.json and sparse_pc.ply as ns-process-data lays them out, and COLMAP's model."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from beags_plugin.system.errors import writing
from beags_plugin.system.reading.ply import write_vertices
from beags_plugin.system.whole_files import write_text_atomically, write_whole

TRANSFORMS = "transforms.json"
POINTS = "sparse_pc.ply"
MODEL = Path("colmap/sparse/0")
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""Turn from COLMAP's world, whose first photo looks along z with y down, to nerfstudio's, where z is roughly up."""
_LENS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")


def write_scene(folder: Path, model: Any) -> None:
    """Write a reconstruction with OPENCV lenses; transforms.json is written last, so that it stands for all files."""
    with writing(folder):
        part = folder / MODEL.parent / ".0.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        model.write(part)
        shutil.rmtree(folder / MODEL, ignore_errors=True)
        part.rename(folder / MODEL)
    points = [model.points3D[key] for key in sorted(model.points3D)]
    xyz = np.array([point.xyz for point in points]).reshape(-1, 3) @ APPLIED[:, :3].T
    rgb = np.array([point.color for point in points]).reshape(-1, 3)
    columns = [*((name, "<f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue"))]
    table = np.rec.fromarrays([*xyz.T, *rgb.T], dtype=columns)
    write_whole(folder / POINTS, lambda file: write_vertices(file, table))
    write_text_atomically(json.dumps(transforms(model), indent=1) + "\n", folder / TRANSFORMS)


def transforms(model: Any) -> dict[str, Any]:
    """Return nerfstudio's transforms.json: frames by name, and one lens for all frames, or one each if they differ."""
    images = sorted((model.images[image_id] for image_id in model.reg_image_ids()), key=lambda image: image.name)
    lenses = {camera_id: _lens(model.cameras[camera_id]) for camera_id in {image.camera_id for image in images}}
    shared = next(iter(lenses.values())) if len(lenses) == 1 else {}
    return {
        "camera_model": "OPENCV",
        **shared,
        "applied_transform": APPLIED.tolist(),
        "ply_file_path": POINTS,
        "frames": [
            {
                "file_path": f"images/{image.name}",
                **({} if shared else lenses[image.camera_id]),
                "transform_matrix": camera_to_world(image).tolist(),
            }
            for image in images
        ],
    }


def camera_to_world(image: Any) -> np.ndarray:
    """Return the pose [4, 4] of a registered photo in nerfstudio's world; its camera looks along -z, y is up."""
    pose = np.eye(4)
    pose[:3] = image.cam_from_world().inverse().matrix()
    pose[:3] = APPLIED[:, :3] @ pose[:3]
    pose[:3, 1:3] *= -1
    return pose


def _lens(camera: Any) -> dict[str, Any]:
    return {"w": camera.width, "h": camera.height, **dict(zip(_LENS, map(float, camera.params), strict=True))}
