"""Seed points from the photos themselves, where few photos leave features few points."""

from __future__ import annotations

import math

import cv2
import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.posing.dense_points import dense_points
from beags_plugin.posing.plane_sweep import PosedPhoto
from beags_plugin.system.progress import progress_bar, say
from beags_plugin.views.small_views import small_camera
from beags_plugin.views.split_photos import resize_area
from beags_plugin.views.views import View, in_unit_range

MOST_PHOTOS = 50  # More show what is in them from enough sides, and would take minutes.
SWEPT_PIXELS = 30_000  # Larger photos are shrunk to as many before they are compared.
PIXELS_OF_POINT = 200  # training pixels for which there is a point


def with_dense_seeds(
    views: list[View], points: torch.Tensor, colors: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return seed points [P, 3] float32, world, and colours [P, 3] uint8, with those that photos agree on added."""
    photos, seen = [], []
    for view in views:
        image, camera = in_unit_range(view.data()["image"]).cpu().numpy(), _small(view.camera.to("cpu"))
        small = np.rint(resize_area(image, camera.width, camera.height).clip(0.0, 1.0) * 255.0).astype(np.uint8)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255.0)
        photos.append(PosedPhoto(grey, camera.K.double().numpy(), camera.viewmat.double().numpy()))
        seen.append(small)
    count = sum(view.camera.width * view.camera.height for view in views) // PIXELS_OF_POINT
    with progress_bar("Comparing photos at many depths") as progress:
        found, found_colors = dense_points(photos, seen, points.double().numpy(), count, progress)
    say(f"{len(found)} seed points more, on whose depth three photos or more agree.")
    more = torch.from_numpy(found).to(points), torch.from_numpy(found_colors).to(colors)
    return torch.cat([points, more[0]]), torch.cat([colors, more[1]])


def _small(camera: Camera) -> Camera:
    shrink = min(1.0, math.sqrt(SWEPT_PIXELS / (camera.width * camera.height)))
    return small_camera(camera, (max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink))))
