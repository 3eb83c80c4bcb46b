"""Violations, by class, of the two constraints that refinement enforces, as curves (method, sections 4 and 6)."""

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
    """Return class id to the mean of B(u) over the class's pixels in a view: the share of other classes' light (E7).

    boundary: [H, W] float, B. labels: [H, W] int32 class ids M' or IGNORE.
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
    """Return class id to the share of its matter that lies where the class was never seen: sum o G Q / sum o G (E9).

    surfels: N Gaussians. class_ids: [N] int32, phi. seed, step: choose the points, uniform in the discs of radius 3, as
    in the loss. Classes without Gaussians are absent.
    """
    sums = disc_sums(surfels, class_ids, grid, samples, seed=seed, step=step)
    opacity = opacities(surfels.opacity_logits.detach()).double()
    opacity = torch.where(torch.isfinite(opacity), opacity, 0.0)
    matter, outside = opacity * sums.whole, opacity * sums.wrong
    ranks = ClassRanks(class_ids)
    places = ranks.ranks(class_ids).long()
    total = torch.bincount(places, weights=matter, minlength=len(ranks)).tolist()
    wrong = torch.bincount(places, weights=outside, minlength=len(ranks)).tolist()
    return {index: w / t for index, w, t in zip(ranks.ids.tolist(), wrong, total, strict=True) if t > 0}
