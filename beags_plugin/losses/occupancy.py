"""The 3D occupancy loss: Gaussians must not reach into space where their class was never seen (paper 3.4; E9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import RADIUS, disc_points, sample_words

CHUNK = 1 << 18  # sample points that are alive at once: bounds memory, whatever Z and N


@torch.no_grad()
def violation_moments(
    surfels: Surfels, class_ids: Tensor, grid: VisibilityGrid, samples: int, seed: int, step: int
) -> Tensor:
    """Sums over the Z samples of each surfel of G Q {1, u, v, u u, u v, v v}: [N, 6].

    E9 and its gradient need nothing else of the samples, so memory does not grow with Z. A surfel whose whole
    disc lies in valid voxels has Q = 0 throughout and is skipped, which changes nothing.
    """
    count = len(surfels)
    moments = surfels.means.new_zeros(count, 6)
    axes = rotation_from_quat(surfels.quats)[:, :, :2] * surfels.log_scales.exp()[:, None]  # s_u R0, s_v R1
    half = RADIUS * axes
    rim = ~grid.disc_inside(surfels.means, half[..., 0], half[..., 1], class_ids)
    index = rim.nonzero()[:, 0]
    if index.shape[0] == 0:
        return moments
    means, axes, classes = surfels.means[index], axes[index], class_ids[index]
    total = means.new_zeros(index.shape[0], 6)
    at_once = max(1, CHUNK // index.shape[0])
    for first in range(0, samples, at_once):
        numbers = torch.arange(first, min(first + at_once, samples), device=means.device)
        u, v = disc_points(sample_words(seed, step, index, numbers), means.dtype)
        x = means + u[..., None] * axes[:, :, 0] + v[..., None] * axes[:, :, 1]
        valid = grid.valid(x.reshape(-1, 3), classes.expand_as(u).reshape(-1)).reshape(u.shape)
        g = torch.where(valid, 0.0, torch.exp(-0.5 * (u * u + v * v)))  # G Q
        total += torch.stack([g, g * u, g * v, g * u * u, g * u * v, g * v * v], dim=-1).sum(dim=0)
    moments[index] = total
    return moments


class _Penalty(torch.autograd.Function):
    """sum_i o_i sum_r G_i(x_r) Q_i(x_r) of samples that are constants in world space, with its gradient."""

    @staticmethod
    def forward(
        ctx: Any, means: Tensor, rotation: Tensor, scales: Tensor, opacity: Tensor, moments: Tensor
    ) -> Tensor:
        ctx.save_for_backward(rotation, scales, opacity, moments)
        return (opacity * moments[:, 0]).sum()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        rotation, scales, opacity, moments = ctx.saved_tensors
        r0, r1 = rotation[:, :, 0], rotation[:, :, 1]
        s_u, s_v = scales[:, :1], scales[:, 1:]
        g, g_u, g_v, g_uu, g_uv, g_vv = (moments * grads[0]).split(1, dim=-1)
        o = opacity[:, None]
        # With x constant: u = (x - p) . R0 / s_u, so du/dp = -R0 / s_u, du/ds_u = -u / s_u,
        # du/dR0 = (x - p) / s_u = u R0 + v (s_v / s_u) R1, and likewise for v; dG = -G (u du + v dv).
        d_means = o * (g_u / s_u * r0 + g_v / s_v * r1)
        d_scales = o * torch.cat([g_uu / s_u, g_vv / s_v], dim=-1)
        d_r0 = -o * (g_uu * r0 + g_uv * (s_v / s_u) * r1)
        d_r1 = -o * (g_uv * (s_u / s_v) * r0 + g_vv * r1)
        d_rotation = torch.stack([d_r0, d_r1, torch.zeros_like(d_r0)], dim=-1)
        return d_means, d_rotation, d_scales, g[:, 0], None  # type: ignore[return-value]


@dataclass(frozen=True)
class OccupancyLoss(Loss):
    """L = 1/(N Z) sum_i sum_r o_i G_i(x_r) [D_occ(x_r, V_phi_i) = 0]; reaches Gaussians that no ray sees (E9).

    samples: Z, points per Gaussian and step.
    """

    weight: float = 10.0
    samples: int = 20

    def value(self, inputs: LossInputs) -> Tensor:
        assert inputs.grid is not None and inputs.class_ids is not None
        surfels = inputs.surfels
        if len(surfels) == 0:
            return surfels.means.sum()
        moments = violation_moments(
            surfels.detach(), inputs.class_ids, inputs.grid, int(self.samples), inputs.seed, inputs.step
        )
        penalty = _Penalty.apply(
            surfels.means,
            rotation_from_quat(surfels.quats),
            surfels.log_scales.exp(),
            torch.sigmoid(surfels.opacity_logits),
            moments,
        )
        return penalty / (len(surfels) * self.samples)
