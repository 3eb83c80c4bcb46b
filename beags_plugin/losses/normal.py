"""Normal consistency: surfels lie in the surface that their own depth describes (2DGS paper, section 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.losses.base import Loss, LossInputs

FLAT = 1e-20  # added under the root: a depth image without slope (nothing drawn) has no normal, and 0 no derivative


def depth_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Normals of a depth image by central differences of the back-projected points.

    depth: [H, W] world units. Returns [H - 2, W - 2, 3] in camera space, unit length, towards the camera; 0 where the
    depth gives no surface. The border, which lacks neighbours, is left out.
    """
    height, width = depth.shape
    x = (torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5 - camera.K[0, 2]) / camera.K[0, 0]
    y = (torch.arange(height, dtype=depth.dtype, device=depth.device) + 0.5 - camera.K[1, 2]) / camera.K[1, 1]
    points = torch.stack([depth * x, depth * y[:, None], depth], dim=-1)
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    # y down x x right points to -z, which is towards the camera
    normal = torch.linalg.cross(down, right, dim=-1)
    return normal / (normal.square().sum(dim=-1, keepdim=True) + FLAT).sqrt()


@dataclass(frozen=True)
class NormalConsistencyLoss(Loss):
    """Mean over inner pixels of sum_i w_i (1 - n_i . n_depth); n_depth is weighted by the (constant) alpha as well."""

    needs: ClassVar[frozenset[str]] = frozenset({"geometry"})

    weight: float = 0.05
    start: int = 7_000

    def value(self, inputs: LossInputs) -> Tensor:
        render = inputs.render
        assert render.depth is not None and render.normal is not None
        alpha = render.alpha[1:-1, 1:-1].detach()
        expected = depth_normals(render.depth, inputs.camera) * alpha[..., None]
        agreement = (render.normal[1:-1, 1:-1] * expected).sum(dim=-1)
        return (1.0 - agreement).mean()
