"""Captures in small, below one root as ``beags bench captures`` finds them, with traced silhouettes beside them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import torch
from data_folders import write_image
from PIL import Image
from run_folders import SETTINGS, discs, ring_cameras, write_drawn_scene

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.select import select_class
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import geometry_inputs

FACTOR = 4  # photos have 80 x 48 pixels; v00 and v08 are held out
NAMES = {"fruit": {1: "apple", 2: "banana"}, "dtu_skull": {1: "skull"}, "bear": {1: "object"}}


def write_capture(root: Path, name: str) -> Path:
    """Write a capture: a drawn scene whose first disc cloud, or both, are its objects; bear has no masks."""
    scene = root / name
    write_drawn_scene(scene, FACTOR)
    if name == "bear":
        shutil.rmtree(scene / "masks")
        (scene / "classes.json").unlink()
        return scene
    (scene / "classes.json").write_text(json.dumps({0: "background", **NAMES[name]}))
    for path in (scene / "masks").glob("*.png"):
        ids = np.asarray(Image.open(path))
        write_image(path, np.where(np.isin(ids, list(NAMES[name])), ids, 0).astype(np.uint8))
    return scene


def write_truth(truth: Path, name: str, views: tuple[str, ...] = ("v00",), untold_rows: int = 0) -> Path:
    """Write silhouettes of a capture's objects in these views; untold_rows: from the top, of value 128."""
    cameras = ring_cameras(9, FACTOR)
    for class_id, each in NAMES[name].items():
        for view in views:
            drawn = silhouette(cameras[int(view[1:])], class_id)
            drawn[:untold_rows] = 128
            write_image(truth / name / each / f"{view}.png", drawn)
    return truth / name


def silhouette(camera: Camera, class_id: int) -> np.ndarray:
    """Return [48, 80] uint8, 255 where the object alone covers a pixel."""
    surfels, ids = discs()
    inputs = geometry_inputs(select_class(surfels, Membership(ids), class_id)[0])
    alpha = make_rasterizer("auto").rasterize(inputs, camera, SETTINGS, torch.zeros(3)).alpha
    return np.uint8(255) * (alpha > 0.5).numpy().astype(np.uint8)


def write_prompts(path: Path, view: str = "v01") -> Path:
    """Write clicks on the first object in a view, and one beside it."""
    camera = ring_cameras(9, FACTOR)[int(view[1:])]
    inside, outside = (np.argwhere(silhouette(camera, class_id)) for class_id in (1, 2))
    row, column = inside[len(inside) // 2].tolist()
    apart = outside[np.argmax(np.abs(outside - [row, column]).sum(axis=1))].tolist()
    prompt = {"view": view, "points": [[column, row]], "outside": [apart[::-1]]}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({"objects": [{"name": "object", "prompts": [prompt]}]}))
    return path
