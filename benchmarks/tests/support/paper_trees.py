"""The paper's data sets in small: one scene each in its download's file tree, with drawn photos and exact masks.

Two clouds of discs stand for two objects, under the names of each data set (``run_folders.discs``).
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from data_folders import CX, CY, FX, FY, HEIGHT, WIDTH, ring, write_image
from layout_folders import FOCAL, write_3dovs, write_lerf_mask, write_llff, write_mipnerf360
from PIL import Image
from run_folders import SETTINGS, discs

from beags_plugin.core.cameras import Camera, viewmat_from_opengl
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs, render_class_map, surfel_inputs

FACTOR = 4  # photos have 80 x 48 pixels
SCENES = {"mip360": "garden", "llff": "fern", "lerf": "figurines", "3dovs": "bed"}
OBJECTS = {
    "mip360": ("table", "vase"),
    "llff": ("fern", "box"),
    "lerf": ("green apple", "old camera"),
    "3dovs": ("red bag", "banana"),
}
MODEL_K = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0 / FACTOR]]  # the K that write_colmap writes
BOUNDS_K = [[FOCAL, 0.0, WIDTH / 2], [0.0, FOCAL, HEIGHT / 2], [0.0, 0.0, 1.0 / FACTOR]]  # write_poses_bounds's K


def cameras(count: int, K: list[list[float]]) -> list[Camera]:
    """Return cameras of ``ring``. K: as of photos of 20 x 12 pixels."""
    matrix = torch.tensor(K) * FACTOR
    return [
        Camera(viewmat_from_opengl(torch.from_numpy(pose)).float(), matrix, FACTOR * WIDTH, FACTOR * HEIGHT)
        for pose in ring(count)
    ]


def photo(camera: Camera) -> np.ndarray:
    """Return [48, 80, 3] uint8."""
    inputs = surfel_inputs(discs()[0], camera)
    color = make_rasterizer("auto").rasterize(inputs, camera, SETTINGS, torch.zeros(3)).color
    return (255 * color.clamp(0, 1)).round().to(torch.uint8).numpy()


def labels(camera: Camera) -> np.ndarray:
    """Return [48, 80] uint8: 1 and 2 where the objects are seen, else 0."""
    found, _ = render_class_map(make_rasterizer("auto"), *discs(), camera, SETTINGS)
    return found.masked_fill((found > 2) | ~covered(discs()[0], camera), 0).to(torch.uint8).numpy()


def covered(surfels: Surfels, camera: Camera) -> torch.Tensor:
    """Return [48, 80] bool, where discs hide more than half of what is behind them."""
    inputs = geometry_inputs(surfels)
    return make_rasterizer("auto").rasterize(inputs, camera, SETTINGS, torch.zeros(3)).alpha > 0.5


def silhouette(camera: Camera, class_id: int) -> np.ndarray:
    """Return [48, 80] uint8, 255 where the object alone covers a pixel."""
    surfels, ids = discs()
    alone = select_class(surfels, Membership(ids), class_id)[0]
    return 255 * covered(alone, camera).numpy().astype(np.uint8)


def replace_photos(folder: Path, views: list[Camera]) -> list[str]:
    """Draw the photos in a folder anew; returns their stems."""
    files = sorted(folder.iterdir())
    for file, camera in zip(files, views, strict=True):
        Image.fromarray(photo(camera)).save(file)
    return [file.stem for file in files]


def write_tree(root: Path, data_set: str) -> Path:
    """Write a scene of ``data_set``, complete, with masks to train on and all truth; return its folder."""
    scene = root / data_set / SCENES[data_set]
    scene.mkdir(parents=True)
    first, second = OBJECTS[data_set]
    if data_set == "mip360":
        write_mipnerf360(scene)
        views = cameras(10, MODEL_K)
        stems = replace_photos(scene / "images_4", views)
        held_out = [0, 8]
    elif data_set == "llff":
        write_llff(scene)
        shutil.rmtree(scene / "images_4")
        views = cameras(10, BOUNDS_K)
        stems = replace_photos(scene / "images", views)
        held_out = [0, 1, 8]  # the second is the view of NVOS
    elif data_set == "lerf":
        write_lerf_mask(scene)
        views = cameras(6, MODEL_K)
        stems = replace_photos(scene / "images", views)
        shutil.rmtree(scene / "object_mask")
        held_out = [2, 5]
    else:
        write_3dovs(scene)
        views = cameras(6, BOUNDS_K)
        stems = replace_photos(scene / "images", views)
        held_out = [0, 4]
    for index, (stem, camera) in enumerate(zip(stems, views, strict=True)):
        if index not in held_out:
            write_image(scene / f"masks/{stem}.png", labels(camera))
            continue
        for class_id, name in ((1, first), (2, second)):
            write_image(scene / f"ground_truth/silhouettes/{name}/{stem}.png", silhouette(camera, class_id))
            visible = 255 * (labels(camera) == class_id).astype(np.uint8)
            if data_set == "lerf":
                write_image(scene / f"test_mask/{held_out.index(index)}/{name}.png", visible)
            elif data_set == "3dovs":
                write_image(scene / f"segmentations/{stem}/{name}.png", visible)
            else:
                write_image(scene / f"ground_truth/visible/{name}/{stem}.png", visible)
    if data_set == "3dovs":
        (scene / "segmentations/classes.txt").write_text(f"{first}\n{second}\n")
        for file in scene.glob("segmentations/*/white sheet.png"):
            file.unlink()
    else:
        (scene / "classes.json").write_text(json.dumps({"1": first, "2": second}))
    return scene
