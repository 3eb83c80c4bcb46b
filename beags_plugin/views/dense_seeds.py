"""Seed points from the photos themselves, for scenes of few photos, whose features give few points."""

from __future__ import annotations

import cv2
import numpy as np
import torch

from beags_plugin.posing.dense_points import dense_points
from beags_plugin.posing.plane_sweep import PosedPhoto
from beags_plugin.system.progress import progress_bar, say
from beags_plugin.views.cameras import small_camera
from beags_plugin.views.close_ups import fitted
from beags_plugin.views.split_photos import resize_area
from beags_plugin.views.views import View, in_unit_range

MOST_PHOTOS = 50  # more photos give enough feature points, and comparing them would take minutes
SWEPT_PIXELS = 30_000  # larger photos are scaled down to this size before they are compared
PIXELS_OF_POINT = 200  # training pixels for each point


def with_dense_seeds(
    views: list[View], points: torch.Tensor, colors: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Add points on whose depth photos agree to seed points [P, 3] float32, world, and colours [P, 3] uint8."""
    photos, seen = [], []
    for view in views:
        size = fitted(view.camera.width, view.camera.height, SWEPT_PIXELS)
        image, camera = in_unit_range(view.data()["image"]).cpu().numpy(), small_camera(view.camera.to("cpu"), size)
        small = np.rint(resize_area(image, camera.width, camera.height).clip(0.0, 1.0) * 255.0).astype(np.uint8)
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / np.float32(255.0)
        photos.append(PosedPhoto(grey, camera.K.double().numpy(), camera.viewmat.double().numpy()))
        seen.append(small)
    count = sum(view.camera.width * view.camera.height for view in views) // PIXELS_OF_POINT
    with progress_bar("Comparing photos at many depths") as progress:
        more, more_colors = dense_points(photos, seen, points.double().numpy(), count, progress)
    say(f"Added {len(more)} seed points on whose depth three or more photos agree.")
    added = torch.from_numpy(more).to(points), torch.from_numpy(more_colors).to(colors)
    return torch.cat([points, added[0]]), torch.cat([colors, added[1]])
