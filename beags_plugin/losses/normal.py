"""Normal consistency: the rendered normals agree with the slope of the rendered depth (method, section 1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import pixel_rays
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.ops import cuda_extension
from beags_plugin.ops.normal_consistency import normal_consistency


@dataclass(frozen=True)
class NormalConsistencyLoss(Loss):
    """Mean over the inner pixels of A (1 - n . n_depth), with A held constant.

    n is the rendered normal sum w n (not normalised) in camera space. The 2DGS paper has sum w (1 - n . n_depth). A is
    constant, as in its authors' code, so that the term does not thin out surfaces. A pixel counts as 0 at the border,
    and where it or one of its four neighbours has no depth.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"geometry"})

    weight: float = 0.05
    start: int = 7000

    def value(self, inputs: LossInputs) -> Tensor:
        return self._scaled(inputs, 1.0)

    def weighted(self, inputs: LossInputs) -> Tensor:
        return self._scaled(inputs, self.weight)

    def _scaled(self, inputs: LossInputs, weight: float) -> Tensor:
        render = inputs.render
        if render.depth is None or render.normal is None:
            raise ValueError("the normal loss needs a render with geometry")
        if cuda_extension.supports(render.depth, render.normal, render.alpha):
            return normal_consistency(render.depth, render.normal, render.alpha, inputs.camera.host.K, weight)
        slope, known = depth_normals(render.depth, inputs.camera)
        error = 1.0 - (render.normal[1:-1, 1:-1] * slope).sum(-1)
        error = torch.where(known, render.alpha.detach()[1:-1, 1:-1] * error, 0.0)
        return weight * ordered_sum(error) / max(error.numel(), 1)


def depth_normals(depth: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return normals of a depth image, from central differences of the points under the pixel centres.

    depth: [H, W] float, along z, 0 where unknown. Returns (normals [H-2, W-2, 3], of unit length, camera space, turned
    towards the camera; known [H-2, W-2] bool). Gradients are finite everywhere; where unknown, the normal is constant.
    """
    points = depth[..., None] * pixel_rays(camera, depth)
    inner = points[1:-1, 1:-1]
    scale = depth.detach()[1:-1, 1:-1, None]
    solid = depth > 0
    known = solid[1:-1, 1:-1] & solid[1:-1, 2:] & solid[1:-1, :-2] & solid[2:, 1:-1] & solid[:-2, 1:-1]
    # Dividing by the depth makes the product independent of the scene's scale; the direction stays the same.
    scale = torch.where(known[..., None], scale, 1.0)
    across = (points[1:-1, 2:] - points[1:-1, :-2]) / scale
    down = (points[2:, 1:-1] - points[:-2, 1:-1]) / scale
    normal = torch.linalg.cross(down, across)
    normal = torch.where((normal * inner).sum(-1, keepdim=True) > 0, -normal, normal)
    squared = (normal * normal).sum(-1)
    known = known & (squared.detach() > torch.finfo(depth.dtype).tiny)
    # Unknown normals become a constant before the root, because its gradient at 0 is not finite.
    towards = torch.tensor([0.0, 0.0, -1.0], dtype=depth.dtype, device=depth.device)
    normal = torch.where(known[..., None], normal, towards)
    length = torch.where(known, squared, 1.0).sqrt()
    return normal / length[..., None], known
