"""FlashSplat: a Gaussian joins each object with more than a threshold of its blending weight; nothing is trained.

Shen, Yang, Wang, "FlashSplat: 2D to 3D Gaussian Splatting Segmentation Solved Optimally", ECCV 2024. A mask rendered
from one label per Gaussian is linear in the labels, so that each label has a closed form. With f the sum of a
Gaussian's weights over the labelled pixels of the object, and r that over all other labelled pixels,

    member  iff  f / n > r / n + gamma,  n = sqrt(f^2 + r^2),
            iff  s > s*(gamma) = (1 + gamma / sqrt(2 - gamma^2)) / 2,  s = f / (f + r).

Objects are taken out one by one against the rest: with gamma >= 0 a Gaussian joins one object or none, with gamma < 0
possibly several.

Differences from the source: sums are float64 and in a fixed order, where the source adds float32 in any order; the
second line above replaces the first, which the source computes; all views vote, as in its scripts (its code takes ten
by default); pixels without a label, which the source does not have, enter no sum; gamma is by default that of one of
its scripts, not 0 as in its code. The source renders no masks of objects: here they are rendered as with all refiners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.preparation.refiner import AssignedScene, Refiner
from beags_plugin.system.errors import UserError

GAMMA = 0.4
"""Bias towards the rest, -1..1: above 0 it drops Gaussians that the object shares with others, below 0 it keeps more of
them. The source's code has 0; its scripts use 0.4 to 0.75 by scene, and less than 0 for removal."""


def threshold(gamma: float = GAMMA) -> float:
    """Return s*(gamma), the share of weight that a member exceeds; raises ``UserError`` for gamma outside -1..1."""
    if not -1.0 <= gamma <= 1.0:
        raise UserError(f"gamma is {gamma:g}, but FlashSplat's bias lies in -1..1: 0 takes the larger side.")
    return (1.0 + gamma / math.sqrt(2.0 - gamma * gamma)) / 2.0


def members(sums: Tensor, totals: Tensor, gamma: float = GAMMA) -> Tensor:
    """Return which of N Gaussians belong to one object, [N] bool; ties go to the rest.

    sums: [N] float64, weights over the object's pixels of all views. totals: [N] float64, those over all labelled
    pixels. As in the source, a Gaussian that no labelled pixel sees joins every object if gamma < 0, otherwise none.
    """
    inside = sums > threshold(gamma) * totals
    return inside | (totals <= 0) if gamma < 0 else inside


@dataclass(frozen=True)
class FlashSplatRefiner(Refiner):
    """Takes every object out of the base against the rest; nothing is trained."""

    gamma: float = GAMMA
    """Bias, -1 to 1: below 0 objects keep more."""

    def __post_init__(self) -> None:
        threshold(self.gamma)  # raises for invalid values

    def members(self, scene: AssignedScene) -> Membership:
        total = scene.contributions.total()
        masks = {c: members(scene.contributions.of(c), total, self.gamma) for c in scene.objects}
        return Membership.of_masks(masks, scene.class_ids)
