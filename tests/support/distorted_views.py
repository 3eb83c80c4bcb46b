"""Scenes photographed through a lens with distortion, by the lens models' formulas."""

from __future__ import annotations

import numpy as np
from data_folders import noise, write_image, write_transforms

from beags_plugin.plugin.views.datamanager import BeagsDataManager, BeagsDataManagerConfig
from beags_plugin.plugin.views.dataparser import BeagsDataParserConfig

LARGE_W, LARGE_H = 160, 120
LENS = dict(w=LARGE_W, h=LARGE_H, fl_x=110.0, fl_y=118.0, cx=71.5, cy=66.25)
BROWN = dict(k1=-0.22, k2=0.05, p1=0.01, p2=-0.008)
FISHEYE = dict(k1=-0.03, k2=0.01, k3=0.002, k4=-0.004)


def manager(root, parser=(), **options) -> BeagsDataManager:
    config = BeagsDataManagerConfig(dataparser=BeagsDataParserConfig(data=root, **dict(parser)), **options)
    return config.setup(device="cpu", test_mode="val", world_size=1, local_rank=0)


def distort(model: str, x: float, y: float) -> tuple[float, float]:
    """Return the pixel (centres at + 0.5) of the ray (x, y, 1) in the distorted image, by the lens models."""
    r2 = x * x + y * y
    if model == "OPENCV":
        k1, k2, p1, p2 = BROWN.values()
        radial = 1 + k1 * r2 + k2 * r2 * r2
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    else:
        theta = np.arctan(np.sqrt(r2))
        powers = [theta ** (2 * i) for i in range(5)]
        coefficients = [1.0, *(FISHEYE.values() if model == "OPENCV_FISHEYE" else (0,) * 4)]
        scale = theta * np.dot(coefficients, powers) / np.sqrt(r2)
        u, v = x * scale, y * scale
    return LENS["fl_x"] * u + LENS["cx"], LENS["fl_y"] * v + LENS["cy"]


def write_distorted(root, model: str, rays) -> np.ndarray:
    """Write a scene whose view 1 shows a disc at each ray, alike in the image and, with ids 1.., in the class map."""
    lens = {"OPENCV": BROWN, "OPENCV_FISHEYE": FISHEYE, "equidistant": {}}[model]
    kind = "OPENCV" if model == "OPENCV" else "OPENCV_FISHEYE"
    write_transforms(root, **{**LENS, **lens, "camera_model": kind})
    for index in range(9):
        write_image(root / f"images/v{index:02d}.png", noise(index, LARGE_W, LARGE_H))
    ids = np.zeros((LARGE_H, LARGE_W), np.uint8)
    rows, columns = np.mgrid[:LARGE_H, :LARGE_W] + 0.5
    for number, ray in enumerate(rays, 1):
        u, v = distort(model, *ray)
        ids[(columns - u) ** 2 + (rows - v) ** 2 < 6.0**2] = number
    write_image(root / "masks/v01.png", ids)
    write_image(root / "images/v01.png", np.repeat((ids > 0)[..., None] * np.uint8(255), 3, axis=2))
    return ids
