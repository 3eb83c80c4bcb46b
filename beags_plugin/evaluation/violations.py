"""Violations of the two constraints that refinement enforces, by class, for curves (method, sections 4 and 6)."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.surfels import Surfels, opacities
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.violation import disc_sums


@torch.no_grad()
def boundary_errors(boundary: Tensor, labels: Tensor) -> dict[int, float]:
    """Return class id to the mean of B(u), the share of other classes' light, over the class's pixels in a view (E7).

    boundary: [H, W] float, B. labels: [H, W] int32 class ids M' or IGNORE.
    """
    known = labels != IGNORE
    errors = boundary[known].double()
    return _ratios(labels[known], errors, torch.ones_like(errors))


@torch.no_grad()
def occupancy_violations(
    surfels: Surfels, class_ids: Tensor, grid: VisibilityGrid, seed: int, step: int, samples: int = 4
) -> dict[int, float]:
    """Return class id to the share of its matter where the class was never seen: sum o G Q / sum o G (E9).

    surfels: N Gaussians. class_ids: [N] int32, phi. seed, step: choose the points, uniform in the discs of radius 3, as
    in the loss. Classes without Gaussians are absent.
    """
    sums = disc_sums(surfels, class_ids, grid, samples, seed=seed, step=step)
    opacity = opacities(surfels.opacity_logits.detach()).double()
    opacity = torch.where(torch.isfinite(opacity), opacity, 0.0)
    return _ratios(class_ids, opacity * sums.wrong, opacity * sums.whole)


def _ratios(class_ids: Tensor, part: Tensor, whole: Tensor) -> dict[int, float]:
    """Return class id to sum of part / sum of whole, all [N], over its entries; classes with a sum of 0 are absent."""
    ranks = ClassRanks(class_ids)
    places = ranks.ranks(class_ids).long()
    parts, wholes = (torch.bincount(places, weights=each, minlength=len(ranks)).tolist() for each in (part, whole))
    return {index: p / w for index, p, w in zip(ranks.ids.tolist(), parts, wholes, strict=True) if w > 0}
