"""A small scene with classes, seen and labelled from several places, one of them without a mask."""

from __future__ import annotations

import torch
from raster_scenes import make_scene
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import render_class_map


def labelled_views(
    count: int, step: float
) -> tuple[Surfels, list[Camera], list[Tensor | None], Rasterizer, RasterSettings]:
    """Return the scene in float32, ``count`` cameras ``step`` apart, their masks, a rasterizer and its settings."""
    scene = make_scene(count=80, size=-1.0, opacity=2.0).to(torch.float32)
    s = scene.inputs
    surfels = Surfels.of(s.means, s.quats, s.log_scales, s.opacity_logits, torch.zeros(len(s.means), 1, 3))
    cameras = []
    for view in range(count):
        viewmat = scene.camera.viewmat.clone()
        viewmat[0, 3] += step * view
        cameras.append(Camera(viewmat, scene.camera.K, scene.camera.width, scene.camera.height))
    rasterizer = make_rasterizer("auto")
    masks: list[Tensor | None] = [
        render_class_map(rasterizer, surfels, s.class_ids, camera, scene.settings)[0] for camera in cameras
    ]
    masks[3] = None
    return surfels, cameras, masks, rasterizer, scene.settings
