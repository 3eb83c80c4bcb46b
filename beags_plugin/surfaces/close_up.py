"""Close-ups of training views: the same position and direction, with the image filled by the object's box."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project

_MARGIN = 2  # pixels around the box, because Gaussians reach beyond one standard deviation


def close_up(camera: Camera, low: Tensor, high: Tensor, near: float, pixels: int) -> Camera:
    """Return the part of a view that contains a box, with a longer side of ``pixels``.

    low, high: [3] corners of the box, in the camera's world. near: depth, world units; if a corner is nearer, the
    camera is in or beside the box, and the whole view is returned. Returns a camera of at most ``pixels`` x ``pixels``;
    float32.
    """
    corners = torch.cartesian_prod(*torch.stack([low, high], dim=1).double())
    xy, z = project(corners, camera)
    whole = bool((z <= near).any())
    first = torch.zeros(2, dtype=torch.float64) if whole else xy.amin(dim=0)
    last = torch.tensor([camera.width, camera.height], dtype=torch.float64) if whole else xy.amax(dim=0)
    size = (last - first).clamp(min=1e-9)
    margin = 0 if whole else min(_MARGIN, (pixels - 1) // 2)
    zoom = (pixels - 2 * margin) / float(size.max())
    K = camera.K.double().clone()
    K[:2] *= zoom
    K[:2, 2] += margin - zoom * first
    # Rounding before ``ceil`` keeps the longer side at ``pixels``: the last bit would add one more.
    width, height = (min(pixels, math.ceil(round(zoom * side, 6)) + 2 * margin) for side in size.tolist())
    return Camera(camera.viewmat.float(), K.float(), max(1, width), max(1, height))
