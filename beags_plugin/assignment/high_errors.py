"""Which Gaussians hold pixels that a scene renders badly, by several views.

The idea is FastGS's (CVPR 2026): errors of single pixels say where a scene lacks Gaussians, if views agree. Here a
Gaussian holds a pixel by its weight w_i there (E4), so that what is hidden holds nothing.
"""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings, SurfelInputs

HIGH = 1.5  # times a view's mean error: from there on a pixel's error is high
SHARE = 0.5  # of a Gaussian's weight in a view: from there on in pixels of high error, that view agrees


class HighErrors:
    """Sums over views of what N Gaussians hold.

    agreeing: [N] int64, views in whose pixels of high error at least ``SHARE`` of the Gaussian's weight lies.
    """

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.agreeing = torch.zeros(count, dtype=torch.int64, device=device)

    def add(self, held: Tensor) -> None:
        """Add one view: held [N, 2], the sums of w_i over its pixels of low and of high error."""
        total = held.sum(dim=1)
        self.agreeing += (total > 0) & (held[:, 1] >= SHARE * total)


def held_by_error(
    rasterizer: Rasterizer, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, error: Tensor
) -> Tensor:
    """Return [N, 2], the sums of w_i over a view's pixels of low and of high error; no gradient.

    inputs: N Gaussians. error: [H, W] float, not negative; high is ``HIGH`` times its mean or more, above 0.
    """
    high = (error > 0) & (error >= HIGH * error.mean())
    return rasterizer.class_contributions(inputs, camera, settings, high.int(), 2)
