"""Downscaling of photos for a training that takes minutes."""

from __future__ import annotations

import contextlib
from pathlib import Path

from beags_plugin.data.dataset import ColmapModel, PoseTable
from beags_plugin.data.files import image_size
from beags_plugin.data.layout import read_dataset
from beags_plugin.data.photo_files import PhotoFinder
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json

QUICK_PIXELS = 50_000  # most pixels of a view


def quick_downscale(data: Path) -> float:
    """Return the smallest whole factor that scales the images of ``data`` to at most ``QUICK_PIXELS``."""
    images = _images(data) or _first_frame(data)
    if not images:
        return 1.0  # the data parser names what is missing
    width, height = image_size(images[0])
    factor = 1
    while width * height / factor**2 > QUICK_PIXELS:
        factor += 1
    return float(factor)


def _images(data: Path) -> list[Path]:
    """Find the images of the layout of ``data``, or those in images/ if the layout is unknown."""
    folder, pattern = data, "images*/**/*"
    with contextlib.suppress(UserError):  # the data parser names what is missing
        poses = read_dataset(data).poses
        if isinstance(poses, PoseTable):
            return list(poses.images)
        if isinstance(poses, ColmapModel):
            folder, pattern = poses.images, "**/*"
    return sorted(path for path in folder.glob(pattern) if path.suffix.lower() in {".jpg", ".jpeg", ".png"})


def _first_frame(data: Path) -> list[Path]:
    """Return the first image of transforms.json that exists; empty without one, or if that file is damaged."""
    try:
        names = [str(frame["file_path"]) for frame in load_json(data / "transforms.json")["frames"]]
        files = PhotoFinder([data, data / "images"]).find(names)
    except (OSError, ValueError, LookupError, TypeError, UserError):  # the data parser names what is wrong
        return []
    return [path for path in files if path is not None][:1]
