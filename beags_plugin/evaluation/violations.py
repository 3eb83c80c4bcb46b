"""How much each class breaks what the two losses of refinement ask for, as figures for curves (method, 4 and 6)."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.class_ranks import ClassRanks
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.sampling import disc_points, sample_words
from beags_plugin.rasterizers.interface import IGNORE


@torch.no_grad()
def boundary_errors(boundary: Tensor, labels: Tensor) -> dict[int, float]:
    """Mean of B(u) over the pixels of each class in a view: the share of light there that other classes give (E7).

    boundary: [H, W] float, B. labels: [H, W] int32 class ids M' or IGNORE. Returns class id to 0..1 for those present.
    """
    known = labels != IGNORE
    ids = labels[known]
    ranks = ClassRanks(ids)
    places = ranks.ranks(ids).long()
    pixels = torch.bincount(places, minlength=len(ranks))
    errors = torch.bincount(places, weights=boundary[known].double(), minlength=len(ranks))
    found = zip(ranks.ids.tolist(), errors.tolist(), pixels.tolist(), strict=True)
    return {class_id: error / count for class_id, error, count in found if count > 0}


@torch.no_grad()
def occupancy_violations(
    surfels: Surfels, class_ids: Tensor, grid: VisibilityGrid, seed: int, step: int, samples: int = 4
) -> dict[int, float]:
    """The share of each class's matter that lies where the class was never seen: sum o G Q / sum o G over samples (E9).

    surfels: N surfels. class_ids: [N] int32, phi. seed, step: decide the points, uniform in the discs of radius 3, as
    the loss draws them. Returns class id to 0..1, of the classes that have Gaussians.
    """
    surfels = surfels.detach()
    rotation = rotation_from_quat(surfels.quats)
    axes = surfels.log_scales.exp()[:, None, :] * rotation[..., :2]  # [N, 3, 2]
    opacity = opacities(surfels.opacity_logits)
    gaussians = torch.arange(len(surfels), device=class_ids.device)
    matter = torch.zeros(len(surfels), dtype=torch.float64, device=class_ids.device)
    outside = torch.zeros_like(matter)
    for sample in range(samples):  # one at a time: memory does not grow with their number
        numbers = torch.tensor([sample], device=class_ids.device)
        u, v = (value[0] for value in disc_points(sample_words(seed, step, gaussians, numbers), surfels.means.dtype))
        points = surfels.means + u[:, None] * axes[..., 0] + v[:, None] * axes[..., 1]
        weight = (opacity * torch.exp(-0.5 * (u * u + v * v))).double()
        weight = torch.where(torch.isfinite(weight), weight, 0.0)
        matter += weight
        outside += weight.masked_fill(grid.valid(points, class_ids), 0.0)
    ranks = ClassRanks(class_ids)
    places = ranks.ranks(class_ids).long()
    total = torch.bincount(places, weights=matter, minlength=len(ranks)).tolist()
    wrong = torch.bincount(places, weights=outside, minlength=len(ranks)).tolist()
    return {index: w / t for index, w, t in zip(ranks.ids.tolist(), wrong, total, strict=True) if t > 0}
