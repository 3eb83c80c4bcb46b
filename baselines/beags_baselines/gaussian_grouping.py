"""Gaussian Grouping as a refiner: codes and their classifier learn while the base trains on (``identity_codes``).

The source learns them with the scene, from scratch. Here they join a trained base, whose number of Gaussians stays, at
the refinement's rates: those of the base, for positions those of its last tenth.

Where the port differs besides: rates of codes and classifier are multiplied by 30,000 / steps, at most 10; the
classifier has an output for each class that there is, while 256 stays in both normalisers; pixels without a label,
which the source does not know, enter no mean; the other terms are the base's, whose loss of normals the source's 3D
Gaussians do not have; the hull is left out where fewer than five inliers in general position remain, where the source
fails. Its masks of pictures, from the classifier of drawn codes, are left out: objects are drawn as with all refiners.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from beags_baselines import identity_codes
from beags_baselines.learned_codes import LearnedCodes
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError

NEIGHBOURS = 0  # purpose of random numbers


@dataclass(frozen=True)
class GaussianGroupingRefiner(Refiner):
    """Cuts every object out by the classes of codes in space; objects may overlap."""

    threshold: float = identity_codes.THRESHOLD
    """Least probability of an object."""
    hull: bool = identity_codes.HULL
    """Gaussians inside the object's hull join it."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a probability, from 0 to below 1.")

    def steps(self, asked: int, views: int, objects: int) -> int:
        return asked

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return IdentityTraining(scene, self)


class IdentityTraining(OwnTraining):
    """Trains the scene, a code of each Gaussian, and the classifier of drawn codes."""

    def __init__(self, scene: TrainedScene, options: GaussianGroupingRefiner) -> None:
        self.scene, self.options = scene, options
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=scene.surfels().means.device))
        self.identities = LearnedCodes(scene, len(self.ranks))

    def before_step(self, step: int) -> Edit | None:
        self.identities.adam.zero_grad()
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms, learned = base(), self.identities
        if inputs.labels is not None and bool((inputs.labels != IGNORE).any()):  # a view without a mask is all IGNORE
            labels = self.ranks.ranked_labels(inputs.labels)
            drawn = learned.drawn(inputs.surfels, inputs.camera)
            terms["identities"] = identity_codes.pixel_loss(learned.classifier, drawn, labels)
        if step % identity_codes.INTERVAL == 0:
            groups = identity_codes.nearest_in_space(inputs.surfels.means, self.scene.generator(step, NEIGHBOURS))
            terms["neighbours"] = identity_codes.neighbour_loss(learned.classifier, learned.codes, groups)
        return terms

    def after_step(self, step: int) -> Edit | None:
        self.identities.step()
        return None

    @torch.no_grad()
    def finish(self) -> Membership:
        surfels = self.scene.surfels().detach()
        self.identities.say_right_pixels(surfels, self.ranks)
        shares = identity_codes.probabilities(self.identities.classifier, self.identities.codes)
        masks = {
            class_id: identity_codes.members(shares, rank, surfels.means, self.options.threshold, self.options.hull)
            for rank, class_id in enumerate(self.ranks.ids.tolist())
            if class_id != 0
        }
        return Membership.of_masks(masks, self.scene.class_ids())

    def figures(self) -> Mapping[str, float]:
        return self.identities.figures

    def state(self) -> dict[str, Any]:
        return self.identities.state()

    def restore(self, state: dict[str, Any]) -> None:
        self.identities.restore(state)
