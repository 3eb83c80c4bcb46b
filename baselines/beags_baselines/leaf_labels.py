"""OpenGaussian's classes of leaves: by votes of the views, each for the mask that a leaf drawn alone looks like.

A leaf's code is the sum of the codes of its masks, here unit vectors e_c of their classes, so that its cosine with e_c
is its share of votes for c up to the length. "classes": a leaf has the class of the largest cosine. "query": a class
takes its best leaf, leaves that are like it, and of these the small Gaussians that are not far from the others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import torch
from torch import Tensor

from beags_baselines.instance_features import inliers
from beags_plugin.core.surfels import Surfels

RULES = ("classes", "query")  # the first is the default
MIN_VIEWS = 2  # votes that a leaf needs: rule "classes"
MIN_VOTES = 5  # the same: rule "query"
MIN_LEAF = 10  # visible Gaussians of a leaf that is drawn
NEXT_BEST, NEAR_CENTRE, SMALL = 9, 0.9, 0.1  # of "query"; the last in units of the input poses

Votes = Mapping[int, Counter[int]]
"""Of each leaf the number of views by the class, a rank, of the mask that it looks like there."""


def classes_of_leaves(votes: Votes, min_views: int = MIN_VIEWS) -> dict[int, int]:
    """Return the rank of the class of each leaf that has one, of equals the lowest."""
    enough = {leaf: found for leaf, found in votes.items() if found.total() >= min_views}
    return {leaf: min(found, key=lambda rank: (-found[rank], rank)) for leaf, found in enough.items()}


def queried_leaves(votes: Votes, rank: int, centres: Tensor, leaves_each: int) -> list[int]:
    """Return the leaves of a class; none where no leaf has a vote for it.

    The best, and of the nine next best those whose centre is near and whose id is below that of the best plus
    ``leaves_each`` (any lower id passes, as in the source). centres: [leaves, 6]. Ties go to the lower id.
    """
    cosines = {
        leaf: found[rank] / sum(count**2 for count in found.values()) ** 0.5
        for leaf, found in votes.items()
        if found.total() >= MIN_VOTES
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
    """Return [N] bool: of the chosen ones those that are small and no outliers; nobody where too few are small.

    chosen: [N] bool. scale: units of the scene per unit of the input poses. least: how many must be small.
    """
    small = chosen & (surfels.log_scales.exp() < SMALL * scale).all(dim=1)
    if int(small.sum()) < least:
        return torch.zeros_like(chosen)
    kept = torch.zeros_like(chosen)
    kept[small] = inliers(surfels.means[small])
    return kept
