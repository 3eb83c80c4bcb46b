"""Photos of a textured corner, three planes that meet, by cameras whose poses are known: for structure from motion."""

from __future__ import annotations

import json
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
_SIDE = 768  # pixels of the texture of a plane, which is 4 wide


@lru_cache
def _textures(seed: int) -> np.ndarray:
    """Return [3, side, side, 3] uint8: noise at several scales, so that there are features near and far."""
    generator = np.random.default_rng(seed)
    whole = np.zeros((3, _SIDE, _SIDE, 3), np.float32)
    for plane in whole:
        for side in (16, 64, 128, 256):
            noise = generator.normal(size=(side, side, 3)).astype(np.float32)
            plane += cv2.resize(noise, (_SIDE, _SIDE), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 30 * whole, 0, 255).astype(np.uint8)


def camera(angle: float, height: float = 1.4) -> np.ndarray:
    """Return camera-to-world [4, 4], looking along -z, of a camera on an arc before the corner at the origin."""
    center = np.array([3.2 * np.cos(angle), 3.2 * np.sin(angle), height])
    back = center - np.array([0.5, 0.5, 0.5])
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, center], axis=1)
    return pose


def errors(found: dict[str, np.ndarray], given: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of rotation and position of each pose; without beags_benchmarks the test is skipped."""
    return pytest.importorskip("beags_benchmarks.studies.poses").errors(found, given)


def photograph(
    pose: np.ndarray, seed: int = 0, shift: tuple[float, float] = (0, 0), turned: bool = False
) -> np.ndarray:
    """Return [H, W, 3] uint8; shift: of the principal point, in pixels; turned: portrait."""
    width, height = (HEIGHT, WIDTH) if turned else (WIDTH, HEIGHT)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([(x - width / 2 - shift[0]) / FOCAL, -(y - height / 2 - shift[1]) / FOCAL, -np.ones_like(x)], -1)
    rays = local @ pose[:3, :3].T
    nearest, image = np.full(x.shape, np.inf), np.zeros((*x.shape, 3), np.uint8)
    for axis, texture in enumerate(_textures(seed)):
        with np.errstate(divide="ignore"):
            way = -pose[axis, 3] / rays[..., axis]
        at = pose[:3, 3] + way[..., None] * rays
        u, v = (np.delete(at, axis, -1)[..., i] for i in range(2))
        hit = (way > 0) & (way < nearest) & (np.minimum(u, v) >= 0) & (np.maximum(u, v) < 4)
        to = [np.where(hit, each, 0).astype(np.float32) * (_SIDE / 4) for each in (u, v)]
        image[hit] = cv2.remap(texture, to[0], to[1], cv2.INTER_LINEAR)[hit]
        nearest = np.where(hit, way, nearest)
    return image


def write_photos(
    folder: Path, count: int = 12, prefix: str = "v", enlarged: int = 1, **settings
) -> dict[str, np.ndarray]:
    """Write photos on an arc, enlarged so many times; returns the pose of each by the stem of its file."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = {}
    for index, angle in enumerate(np.linspace(0.25, 1.3, count)):
        name = f"{prefix}{index:02d}"
        poses[name] = camera(float(angle), 1.2 + 0.4 * (index % 3))
        picture = Image.fromarray(photograph(poses[name], **settings))
        size = picture.width * enlarged, picture.height * enlarged
        picture.resize(size, Image.Resampling.BICUBIC).save(folder / f"{name}.png")
    return poses


@contextmanager
def quiet(name):
    """Stand for a progress bar."""
    yield lambda done, total: None


def frames(folder: Path) -> dict[str, np.ndarray]:
    """Return the pose that a scene's transforms.json holds of each photo, by the stem of its file."""
    meta = json.loads((folder / "transforms.json").read_text())
    return {Path(frame["file_path"]).stem: np.array(frame["transform_matrix"]) for frame in meta["frames"]}


def film(path: Path, pictures: list[np.ndarray]) -> Path:
    """Write a video of pictures [H, W, 3] uint8; returns ``path``."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        container.mux(stream.encode())
    return path


def look_alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether pictures [H, W, 3] are of one size and differ by a lossy format alone."""
    if one.shape != other.shape:
        return False
    return bool(np.abs(cv2.blur(one, (9, 9)).astype(int) - cv2.blur(other, (9, 9))).mean() < 4)
