"""Discs that face a camera of their own size in pixels, for numbers that can be worked out by hand."""

from __future__ import annotations

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import RasterOutputs, RasterSettings, SurfelInputs
from beags_plugin.rasterizers.torch_reference import TorchRasterizer

FOCAL = 100.0


def camera(size: int) -> Camera:
    """A square picture; at depth 1 a pixel is 1 / FOCAL wide."""
    K = torch.tensor([[FOCAL, 0.0, size / 2], [0.0, FOCAL, size / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(torch.eye(4, dtype=torch.float64), K, size, size)


def discs(size: int, centers, sigma: float, opacities, depths=None) -> SurfelInputs:
    """Discs in float64 at pixel positions ``centers``, ``sigma`` pixels wide, by default all at depth 1."""
    count = len(centers)
    depth = torch.tensor(depths or [1.0] * count, dtype=torch.float64)
    xy = (torch.tensor(centers, dtype=torch.float64).view(count, 2) - size / 2) / FOCAL * depth[:, None]
    return SurfelInputs(
        means=torch.cat([xy, depth[:, None]], dim=1),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).repeat(count, 1),
        log_scales=(sigma / FOCAL * depth.abs()).log()[:, None].repeat(1, 2),
        opacity_logits=torch.logit(torch.tensor(opacities, dtype=torch.float64).expand(count)).clone(),
        colors=torch.zeros(count, 3, dtype=torch.float64),
    )


def drawn(inputs: SurfelInputs, view: Camera) -> RasterOutputs:
    """Draw them on black through the reference."""
    settings = RasterSettings(near=0.01, far=100.0, geometry=False)
    return TorchRasterizer().rasterize(inputs, view, settings, torch.zeros(3, dtype=torch.float64))
