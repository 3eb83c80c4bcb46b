"""Tiny scenes on disk for the tests of the data side."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image
from places import ROOT

SCENES = ROOT.parent / "shared/scenes"
WIDTH, HEIGHT = 20, 12
FX, FY, CX, CY = 17.0, 16.0, 8.5, 6.75  # the principal point is off the centre on purpose


def look_at(position, target=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Return camera-to-world [4, 4] in OpenGL axes, z up in the world."""
    back = np.asarray(position, float) - np.asarray(target, float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(back, right), back, np.asarray(position, float)], axis=1)
    return pose


def ring(count: int) -> list[np.ndarray]:
    """Return poses on a circle of radius 3, looking at the origin from slightly above."""
    angles = 2 * np.pi * np.arange(count) / count
    return [look_at((3 * np.cos(a), 3 * np.sin(a), 0.5 + 0.1 * np.sin(3 * a))) for a in angles]


def write_image(path: Path, array: np.ndarray) -> None:
    """Write any uint8 or uint16 array as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)


def noise(seed: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return [H, W, 3] uint8."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def write_transforms(root: Path, count: int = 9, per_frame: bool = False, poses=None, **extra) -> list[np.ndarray]:
    """Write a transforms.json scene with noise images images/v00.png, ...; frames are in reverse name order."""
    poses = ring(count) if poses is None else poses
    intrinsics = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    frames = []
    for index, pose in enumerate(poses):
        write_image(root / f"images/v{index:02d}.png", noise(index))
        own = dict(intrinsics, cx=CX + 0.25 * index) if per_frame else {}
        frames.append({"file_path": f"images/v{index:02d}.png", "transform_matrix": pose.tolist(), **own})
    meta = {"camera_model": "OPENCV", **({} if per_frame else intrinsics), "frames": frames[::-1], **extra}
    (root / "transforms.json").write_text(json.dumps(meta))
    return poses


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return wxyz of a rotation matrix, as the eigenvector of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    matrix = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    return np.linalg.eigh(matrix)[1][:, -1]


def write_colmap(
    root: Path, count: int = 9, text: bool = False, folder: str = "sparse/0", points=None, names=None
) -> np.ndarray:
    """Write a COLMAP PINHOLE model with image ids against the name order; return world-to-camera [V, 4, 4], OpenCV.

    names: of the images, sorted; v00.png, ... if None.
    """
    names = [f"v{index:02d}.png" for index in range(count)] if names is None else list(names)
    count = len(names)
    model = root / folder
    model.mkdir(parents=True)
    matrices = np.stack([np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0])) for pose in ring(count)])
    lines, binary = [], struct.pack("<Q", count)
    for index, matrix in enumerate(matrices):
        name, image_id = names[index], count - index
        write_image(root / "images" / name, noise(index))
        values = [*quaternion(matrix[:3, :3]), *matrix[:3, 3]]
        lines.append(f"{image_id} {' '.join(map(repr, map(float, values)))} 1 {name}\n\n")
        binary += struct.pack("<i7di", image_id, *values, 1) + name.encode() + b"\0" + struct.pack("<Q", 0)
    points = np.zeros((0, 3)) if points is None else np.asarray(points, float)
    if text:
        (model / "images.txt").write_text("".join(lines))
        (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} {FX} {FY} {CX} {CY}\n")
        body = [f"{i + 1} {x} {y} {z} 10 20 30 0.5\n" for i, (x, y, z) in enumerate(points)]
        (model / "points3D.txt").write_text("".join(body))
        return matrices
    (model / "images.bin").write_bytes(binary)
    camera = struct.pack("<Qii2Q4d", 1, 1, 1, WIDTH, HEIGHT, FX, FY, CX, CY)  # model 1 is PINHOLE
    (model / "cameras.bin").write_bytes(camera)
    body = b"".join(struct.pack("<Q3d3BdQ", i + 1, *p, 10, 20, 30, 0.5, 0) for i, p in enumerate(points))
    (model / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + body)
    return matrices
