"""The 3D occupancy loss per Gaussian, for display and figures (method, section 6; E9)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import RADIUS, disc_points, sample_words

_CHUNK_POINTS = 1 << 18  # points looked up at a time: bounds the memory


@dataclass(frozen=True)
class DiscSums:
    """Sums over points x_r of the disc of each Gaussian, [N] float64; 0 for Gaussians that are not finite.

    whole: sum_r G(x_r). wrong: sum_r G(x_r) Q(x_r), the part where the class was never seen. The loss is the mean over
    Gaussians of opacity times ``wrong``, divided by the number of points.
    """

    whole: Tensor
    wrong: Tensor


@torch.no_grad()
def disc_sums(
    surfels: Surfels,
    class_ids: Tensor,
    grid: VisibilityGrid,
    samples: int,
    background: bool = True,
    seed: int = 0,
    step: int = 0,
) -> DiscSums:
    """Sum G and G Q over points of each Gaussian's disc (E9).

    Q(x) = 1 where D_occ(x, V_phi) = 0, else 0; the x_r are uniform in the UV disc, as in the loss.

    surfels: N Gaussians. class_ids: [N] int, phi. samples: Z, points per Gaussian. background: whether the loss acts
    on class 0; otherwise its ``wrong`` is 0. seed, step: determine the points.
    """
    means = surfels.means.detach()
    axes = surfels.log_scales.detach().exp()[:, None, :] * rotation_from_quat(surfels.quats.detach())[..., :2]
    # Discs inside valid voxels have a ``wrong`` of exactly 0.
    tested = ~grid.disc_inside(means, RADIUS * axes[..., 0], RADIUS * axes[..., 1], class_ids)
    if not background:
        tested &= class_ids != 0
    whole = torch.zeros(len(surfels), dtype=torch.float64, device=means.device)
    wrong = torch.zeros_like(whole)
    numbers = torch.arange(samples, device=means.device)
    finite = means.isfinite().all(1) & axes.isfinite().all(2).all(1)
    for part in finite.nonzero()[:, 0].split(max(1, _CHUNK_POINTS // samples)):
        u, v = disc_points(sample_words(seed, step, part, numbers), means.dtype)  # [Z, m]
        weight = torch.exp(-0.5 * (u * u + v * v))
        whole[part] = weight.sum(0, dtype=torch.float64)
        chosen = tested[part]
        part, u, v, weight = part[chosen], u[:, chosen], v[:, chosen], weight[:, chosen]
        points = means[part] + u[..., None] * axes[part, :, 0] + v[..., None] * axes[part, :, 1]
        valid = grid.valid(points.view(-1, 3), class_ids[part].repeat(samples)).view_as(u)
        wrong[part] = weight.masked_fill(valid, 0.0).sum(0, dtype=torch.float64)
    return DiscSums(whole, wrong)
