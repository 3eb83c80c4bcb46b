"""Where the 3D occupancy loss acts, per Gaussian: for looking at (method, section 6; E9)."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import RADIUS, disc_points, sample_words

_CHUNK_POINTS = 1 << 18  # points looked up at a time: bounds the memory, never changes the result


@torch.no_grad()
def violation_shares(
    surfels: Surfels, class_ids: Tensor, grid: VisibilityGrid, samples: int = 20, background: bool = True, seed: int = 0
) -> Tensor:
    """How much of each Gaussian lies where its class was never seen: sum_r G(x_r) Q(x_r) / sum_r G(x_r), in 0..1.

    Q(x) = 1 where D_occ(x, V_phi) = 0, else 0; the x_r are uniform in the UV disc, as in the loss, which penalises
    opacity times the same sum.

    surfels: N surfels. class_ids: [N] int, phi. samples: Z, points per Gaussian. background: whether the loss acts on
    the Gaussians of class 0. Returns [N] float; 0 for surfels that are not finite.
    """
    scales = surfels.log_scales.detach().exp()
    axes = scales[:, None, :] * rotation_from_quat(surfels.quats.detach())[..., :2]  # [N, 3, 2]
    means = surfels.means.detach()
    asked = means.isfinite().all(1) & axes.isfinite().all(2).all(1)
    asked &= ~grid.disc_inside(means, RADIUS * axes[..., 0], RADIUS * axes[..., 1], class_ids)  # exactly 0 inside
    if not background:
        asked &= class_ids != 0
    shares = means.new_zeros(len(surfels))
    numbers = torch.arange(samples, device=means.device)
    for part in asked.nonzero()[:, 0].split(max(1, _CHUNK_POINTS // samples)):
        u, v = disc_points(sample_words(seed, 0, part, numbers), means.dtype)  # [Z, m]
        points = means[part] + u[..., None] * axes[part, :, 0] + v[..., None] * axes[part, :, 1]
        valid = grid.valid(points.view(-1, 3), class_ids[part].repeat(samples)).view_as(u)
        weight = torch.exp(-0.5 * (u * u + v * v))
        shares[part] = weight.masked_fill(valid, 0.0).sum(0) / weight.sum(0)
    return shares
