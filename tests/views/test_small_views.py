"""Cameras of photos that were shrunk."""

from __future__ import annotations

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings, SurfelInputs
from beags_plugin.views.cameras import small_camera


def test_a_small_camera_renders_the_average_of_the_whole_picture():
    """A smooth scene off the centre, at a third of the width and half of the height: each axis has its own factor."""
    K = torch.tensor([[300.0, 0, 110.3], [0, 280.0, 71.9], [0, 0, 1]])
    camera = Camera(torch.eye(4), K, 240, 180)
    g = torch.Generator().manual_seed(1)
    spread = torch.randn(12, 3, generator=g) * torch.tensor([0.8, 0.5, 0.2])
    scene = SurfelInputs(
        spread + torch.tensor([0.1, 0.1, 4.0]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(12, 1),
        torch.full((12, 2), -0.7),
        torch.zeros(12),
        torch.rand(12, 3, generator=g),
    )
    small = small_camera(camera, (80, 90))
    rasterizer, settings = make_rasterizer("torch"), RasterSettings(0.01, 100.0, geometry=False)
    whole, found = (rasterizer.rasterize(scene, each, settings, torch.zeros(3)).color for each in (camera, small))
    averaged = whole.reshape(90, 2, 80, 3, 3).mean((1, 3))
    error = (found - averaged).abs()
    assert error.mean() < 1e-3 and error.max() < 0.02
    shifted = (found.roll(1, dims=1) - averaged).abs()[:, 2:]
    assert shifted.mean() > 5 * error.mean()  # half a pixel would show
