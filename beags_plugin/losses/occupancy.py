"""The 3D occupancy loss: no Gaussian reaches where its class was never seen (method, section 6; paper 3.4; E9)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat, usable_quats
from beags_plugin.core.surfels import opacities as opacities_of
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import RADIUS, disc_points, sample_stream, sample_words
from beags_plugin.ops import cuda_extension
from beags_plugin.ops.occupancy_loss import occupancy_loss
from beags_plugin.system.errors import UserError

_CHUNK_POINTS = 1 << 16  # Points looked up at a time; their temporaries fit into the cache. The result is the same.


@dataclass(frozen=True)
class OccupancyLoss(Loss):
    """L = 1 / (N Z) sum_i sum_r o_i G_i(x_r) Q_i(x_r), Q = 1 where D_occ(x_r, V_phi_i) = 0, else 0 (E9).

    Hidden Gaussians learn too. A Gaussian counts as 0 if one of its parameters is not finite or a scale is 0. Memory
    does not depend on ``samples``. The compiled op computes the loss where it can; the code here is its reference.

    samples: Z, points in each Gaussian and step, uniform in its disc of radius 3 in (u, v).
    background: share of the weight on the Gaussians of the background: 1 as in the paper, 0 leaves them out.
    """

    weight: float = 10.0

    samples: int = 20
    background: float = 1.0

    def __post_init__(self) -> None:
        if not (self.samples >= 1 and float(self.samples).is_integer()):
            raise UserError(f"the occupancy loss has samples = {self.samples}: it must be a whole number, 1 or more.")
        if not 0.0 <= self.background <= 1.0:
            raise UserError(f"the occupancy loss has background = {self.background}: give a share from 0 to 1.")

    @property
    def asks_grid_about_background(self) -> bool:
        return self.background > 0.0

    def value(self, inputs: LossInputs) -> Tensor:
        return self._scaled(inputs, 1.0)

    def weighted(self, inputs: LossInputs) -> Tensor:
        return self._scaled(inputs, self.weight)

    def _scaled(self, inputs: LossInputs, weight: float) -> Tensor:
        terms = [(weight * self.background, True), (weight * (1.0 - self.background), False)]
        parts = [self._part(inputs, share, background) for share, background in terms if share != 0.0]
        return sum(parts[1:], parts[0]) if parts else self._part(inputs, 0.0, False)

    def _part(self, inputs: LossInputs, weight: float, background: bool) -> Tensor:
        """Return ``weight`` times the loss of the objects; ``background``: of all classes, at the same points."""
        surfels, grid, class_ids = inputs.surfels, inputs.grid, inputs.class_ids
        if grid is None or class_ids is None:
            raise ValueError("the occupancy loss needs class ids and a visibility grid")
        num_samples = int(self.samples)
        parameters = (surfels.means, surfels.quats, surfels.log_scales, surfels.opacity_logits)
        lookup = grid.lookup()
        compiled = cuda_extension.supports(*parameters)
        if lookup is not None and compiled:
            stream = sample_stream(inputs.seed, inputs.step)
            ids = class_ids.int()
            return occupancy_loss(*parameters, ids, lookup, stream, num_samples, background, weight)
        active = _outside(*parameters, class_ids, grid)
        if not background:
            active = active[class_ids[active] != 0]
        rotation = rotation_from_quat(surfels.quats[active])
        per_gaussian = _Occupancy.apply(
            surfels.means[active],
            rotation[..., 0],
            rotation[..., 1],
            surfels.log_scales[active],
            surfels.opacity_logits[active],
            class_ids[active],
            grid,
            (inputs.seed, inputs.step, active, num_samples),
        )
        return weight * ordered_sum(per_gaussian) / max(len(surfels) * num_samples, 1)


@torch.no_grad()
def _outside(means, quats, log_scales, opacity_logits, class_ids: Tensor, grid: VisibilityGrid) -> Tensor:
    """Return [M] int64, the Gaussians whose disc is not wholly in valid voxels; the loss of others is exactly 0."""
    scales = log_scales.exp()
    half_axes = RADIUS * scales[:, None, :] * rotation_from_quat(quats)[..., :2]  # [N, 3, 2]
    inside = grid.disc_inside(means, half_axes[..., 0], half_axes[..., 1], class_ids)
    finite = means.isfinite().all(1) & half_axes.isfinite().all(2).all(1) & opacity_logits.isfinite()
    finite &= (1.0 / scales).isfinite().all(1) & usable_quats(quats)
    return torch.nonzero(finite & ~inside)[:, 0]


class _Occupancy(torch.autograd.Function):
    """Compute sum_r o G(x_r) Q(x_r) of every Gaussian, [M], with closed-form gradients from six sums over its samples.

    The points x are constants in the world: u = R0 . (x - p) / s_u and v = R1 . (x - p) / s_v are functions of p, R0,
    R1 and s, and G = exp(-(u^2 + v^2) / 2).
    """

    @staticmethod
    def forward(ctx, means, r0, r1, log_scales, opacity_logits, class_ids, grid, counters) -> Tensor:
        scales = log_scales.exp()
        opacities = opacities_of(opacity_logits)
        s_u, s_v = scales[:, :1], scales[:, 1:]
        sums = _sums(means, s_u * r0, s_v * r1, class_ids, grid, *counters)
        g, gu, gv, guu, gvv, guv = sums[..., None].unbind(0)
        o = opacities[:, None]
        ctx.save_for_backward(
            o * (gu / s_u * r0 + gv / s_v * r1),  # dG/dp = G (u / s_u R0 + v / s_v R1)
            -o * (guu * r0 + guv * (s_v / s_u) * r1),  # dG/dR0 = -G u (x - p) / s_u, x - p = u s_u R0 + v s_v R1
            -o * (guv * (s_u / s_v) * r0 + gvv * r1),  # dG/dR1 = -G v (x - p) / s_v
            o * torch.cat([guu, gvv], dim=1),  # dG/ds_u = G u^2 / s_u, so dG/d(log s_u) = G u^2
            opacities * (1.0 - opacities) * sums[0],
        )
        return opacities * sums[0]

    @staticmethod
    def backward(ctx, *grad_outputs: Tensor):
        *vectors, opacity = ctx.saved_tensors
        grad = grad_outputs[0]
        return *(grad[:, None] * vector for vector in vectors), grad * opacity, None, None, None


def _sums(
    means: Tensor, axes_u: Tensor, axes_v: Tensor, class_ids: Tensor, grid: VisibilityGrid,
    seed: int, step: int, gaussians: Tensor, num_samples: int,
) -> Tensor:  # fmt: skip
    """Return [6, M], sums over the samples of G Q times 1, u, v, u^2, v^2 and u v."""
    total = means.new_zeros(6, len(means))
    block = min(max(len(means), 1), _CHUNK_POINTS)
    per_chunk = max(1, _CHUNK_POINTS // block)
    for first in range(0, len(means), block):
        part = slice(first, first + block)
        for start in range(0, num_samples, per_chunk):
            samples = torch.arange(start, min(start + per_chunk, num_samples), device=means.device)
            u, v = disc_points(sample_words(seed, step, gaussians[part], samples), means.dtype)  # [z, m]
            points = means[part] + u[..., None] * axes_u[part] + v[..., None] * axes_v[part]
            valid = grid.valid(points.view(-1, 3), class_ids[part].repeat(len(samples))).view_as(u)
            weight = torch.exp(-0.5 * (u * u + v * v)).masked_fill_(valid, 0.0)
            wu, wv = weight * u, weight * v
            terms = torch.stack([weight, wu, wv, wu * u, wv * v, wu * v], dim=1)  # [z, 6, m]
            # Determinism: the samples are added one after the other, so the size of chunks does not change the sum.
            for term in terms:
                total[:, part] += term
    return total
