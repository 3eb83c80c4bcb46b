"""Disagreement of depths between neighbouring views, an estimate of the error of one pixel's depth."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.masks.reprojection import PixelMaps, landing

_VIEWS = 48  # views compared with their neighbours, at most
_SAMPLES = 1 << 16  # pixels of them, at most
_ALIKE = 0.7  # least cosine between the axes of neighbouring views: 45 degrees


def disagreement(depths: Sequence[Tensor], cameras: Sequence[Camera], tau: float, share: float) -> float | None:
    """Return the ``share`` quantile of differences in depth between neighbouring views, in pixels (z / focal length).

    depths: V x [H, W] float, world units along z; 0: nothing rendered. Each view, or some of many, is compared with the
    nearest one that looks the same way. tau: points further than tau z from the other depth are hidden and do not
    count. None if no two views show the same point.
    """
    pairs = [(i, j) for i, j in enumerate(_neighbours(cameras)) if j is not None]
    pairs = [pairs[n * len(pairs) // _VIEWS] for n in range(_VIEWS)] if len(pairs) > _VIEWS else pairs
    step = max(1, sum(cameras[i].height * cameras[i].width for i, _ in pairs) // _SAMPLES)
    apart = [_apart(depths[i], depths[j], cameras[i], cameras[j], tau, step) for i, j in pairs]
    found = torch.cat(apart) if apart else torch.zeros(0)
    return float(found.quantile(share)) if len(found) else None


def _neighbours(cameras: Sequence[Camera]) -> list[int | None]:
    """Return the index of each view's neighbour, or None."""
    views = [camera.to("cpu", torch.float64) for camera in cameras]
    centres, axes = (torch.stack(values) for values in zip(*((v.center, v.rotation[2]) for v in views), strict=True))
    found = []
    for i in range(len(views)):
        distance = (centres - centres[i]).norm(dim=1)
        distance[(axes * axes[i]).sum(dim=1) < _ALIKE] = torch.inf
        distance[i] = torch.inf
        nearest = int(distance.argmin())
        found.append(nearest if distance[nearest] < torch.inf else None)
    return found


def _apart(depth: Tensor, shown: Tensor, camera: Camera, other: Camera, tau: float, step: int) -> Tensor:
    """Return [P] float64, for each ``step``-th pixel of a view whose point the other view sees."""
    pixel = torch.arange(0, depth.numel(), step)
    # On the CPU, so that every device finds the same bits.
    d, shown = depth.reshape(-1)[::step].cpu(), shown.cpu()
    x, y = pixel % camera.width + 0.5, pixel // camera.width + 0.5
    A, b = (values[0] for values in PixelMaps([camera, other]).towards(1))
    _, there, z = landing(x, y, d, (A, b), (other.width, other.height), d > 0)
    error = (z - shown.reshape(-1)[there]).abs()
    seen = error <= tau * z  # False for NaN
    return (error[seen] * other.focal / z[seen]).double()
