"""Pictures of classes and boundary errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.colors import colorize
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs


def class_picture(class_map: Tensor) -> Tensor:
    """Return [H, W, 3] float32 in 0..1, the classes' colours. class_map: [H, W] integer ids or IGNORE."""
    colors = colorize(class_map.cpu().numpy().astype(np.uint16))
    return torch.from_numpy(colors).to(class_map.device).float() / 255.0


@torch.no_grad()
def boundary_picture(
    rasterizer: Rasterizer, surfels: Surfels, class_ids: Tensor, camera: Camera, settings: RasterSettings, mask: Tensor
) -> Tensor:
    """Return [H, W, 1] in 0..1, B(u): the share of each pixel that shows another class than its mask (E7).

    surfels: N Gaussians. class_ids: [N] int32, phi. mask: [H, W] int32 ids of this view, or IGNORE, where B is 0.
    """
    inputs = geometry_inputs(surfels, class_ids)
    bare = replace(settings, geometry=False, distortion=False)
    boundary = rasterizer.rasterize(inputs, camera, bare, inputs.means.new_zeros(3), mask).boundary
    assert boundary is not None
    return boundary[..., None]


def fitted_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the same view at the largest size that fits into ``width`` x ``height`` pixels, each side at least 1."""
    factor = min(width / camera.width, height / camera.height)
    new_width = min(max(1, round(camera.width * factor)), width)
    new_height = min(max(1, round(camera.height * factor)), height)
    scale = camera.K.new_tensor([new_width / camera.width, new_height / camera.height, 1.0])
    return Camera(camera.viewmat, camera.K * scale[:, None], new_width, new_height)


def framed(picture: Tensor, width: int, height: int) -> Tensor:
    """Return [height, width, C], ``picture`` [h, w, C] in the middle of a black one that is no smaller."""
    frame = picture.new_zeros(height, width, picture.shape[2])
    top, left = (height - picture.shape[0]) // 2, (width - picture.shape[1]) // 2
    frame[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
    return frame


def nearest_view(camera: Camera, views: Sequence[Camera], extent: float) -> int:
    """Return the index of the view with the nearest centre and direction.

    extent: size of the scene, world units; such a distance counts as much as a right angle between the views.
    """
    centers = torch.stack([view.center for view in views]).double()
    forwards = torch.stack([view.rotation[2] for view in views]).double()
    apart = (centers - camera.center.double()).norm(dim=1) / extent
    turned = 1.0 - forwards @ camera.rotation[2].double()
    return int((apart + turned).argmin())
