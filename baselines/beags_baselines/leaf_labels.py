"""OpenGaussian's classes of leaves by votes of the views, each for the mask that matches the leaf rendered alone.

A leaf's code is the sum of the codes of its masks, here unit vectors e_c of their classes, so that its cosine with e_c
is proportional to its share of votes for c. "classes": a leaf has the class of the largest cosine. "query": a class
takes its best leaf and similar ones, and of these the small Gaussians that are not far from the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import torch
from torch import Tensor

from beags_baselines.instance_features import inliers
from beags_plugin.core.surfels import Surfels

RULES = ("classes", "query")  # the first is the default
MIN_VIEWS = 2  # votes that a leaf needs for "classes"
MIN_VOTES = 5  # votes that a leaf needs for "query"
MIN_LEAF = 10  # visible Gaussians of a leaf that is rendered
NEXT_BEST, NEAR_CENTRE, SMALL = 9, 0.9, 0.1  # choices of "query"; the last in units of the input poses

Votes = Mapping[int, Counter[int]]
"""Leaf to class, a rank, to the number of views in which a mask of the class matches the leaf."""


def classes_of_leaves(votes: Votes, min_views: int = MIN_VIEWS) -> dict[int, int]:
    """Return leaf to the rank of its class, for leaves with enough votes; ties go to the lowest rank."""
    enough = {leaf: counts for leaf, counts in votes.items() if counts.total() >= min_views}
    return {leaf: min(counts, key=lambda rank: (-counts[rank], rank)) for leaf, counts in enough.items()}


def queried_leaves(votes: Votes, rank: int, centres: Tensor, leaves_each: int) -> list[int]:
    """Return the leaves of a class; none if no leaf has a vote for it.

    They are the best leaf, and those of the nine next best whose centre is near and whose id is below that of the best
    plus ``leaves_each`` (any lower id passes, as in the source). centres: [leaves, 6]. Ties go to the lower id.
    """
    cosines = {
        leaf: counts[rank] / sum(count**2 for count in counts.values()) ** 0.5
        for leaf, counts in votes.items()
        if counts.total() >= MIN_VOTES
    }
    order = sorted(cosines, key=lambda leaf: (-cosines[leaf], leaf))
    if not order or cosines[order[0]] == 0.0:
        return []
    best = order[0]
    near = [
        leaf
        for leaf in order[1 : 1 + NEXT_BEST]
        if leaf - best < leaves_each and float((centres[leaf] - centres[best]).norm()) < NEAR_CENTRE
    ]
    return [best, *near]


def queried_object(surfels: Surfels, chosen: Tensor, scale: float, least: int) -> Tensor:
    """Return the chosen Gaussians that are small and no outliers, [N] bool; none if too few are small.

    chosen: [N] bool. scale: units of the scene per unit of the input poses. least: number that must be small.
    """
    small = chosen & (surfels.log_scales.exp() < SMALL * scale).all(dim=1)
    if int(small.sum()) < least:
        return torch.zeros_like(chosen)
    inside = torch.zeros_like(chosen)
    inside[small] = inliers(surfels.means[small])
    return inside
