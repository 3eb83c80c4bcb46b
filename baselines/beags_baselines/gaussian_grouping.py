"""Gaussian Grouping as a refiner: codes and their classifier are trained together with the scene (``identity_codes``).

The source trains them from scratch with the scene. Here they are added to a trained base, whose number of Gaussians
stays fixed, at the refinement's rates: those of the base, for positions those of its last tenth.

Other differences from the source: rates of codes and classifier are multiplied by 30,000 / steps, at most 10; the
classifier has one output for each class of the scene, while 256 stays in both normalisers; pixels without a label,
which the source does not have, enter no mean; the other terms are the base's, including its loss of normals, which the
source's 3D Gaussians do not have; an object with fewer than five inliers in general position has no hull, where the
source fails. The source's masks from the classifier of rendered codes are left out: objects are rendered as with all
refiners.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from beags_baselines import identity_codes
from beags_baselines.learned_codes import CodeTraining
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError

NEIGHBOURS = 0  # purpose of random numbers


@dataclass(frozen=True)
class GaussianGroupingRefiner(Refiner):
    """Takes objects out by the classes of the Gaussians' codes; objects may overlap."""

    threshold: float = identity_codes.THRESHOLD
    """Least probability of an object."""
    hull: bool = identity_codes.HULL
    """Gaussians inside the object's hull join it."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a probability, from 0 to below 1.")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return IdentityTraining(scene, self)


class IdentityTraining(CodeTraining):
    """Trains the scene, a code of each Gaussian, and the classifier of rendered codes."""

    def __init__(self, scene: TrainedScene, options: GaussianGroupingRefiner) -> None:
        super().__init__(scene)
        self.options = options

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms, learned = base(), self.learned
        if inputs.labels is not None and bool((inputs.labels != IGNORE).any()):  # a view without a mask is all IGNORE
            labels = ranked_labels(self.ranks, inputs.labels)
            rendered = learned.rendered(inputs.surfels, inputs.camera)
            terms["identities"] = identity_codes.pixel_loss(learned.classifier, rendered, labels)
        if step % identity_codes.INTERVAL == 0:
            groups = identity_codes.nearest_in_space(inputs.surfels.means, self.scene.generator(step, NEIGHBOURS))
            terms["neighbours"] = identity_codes.neighbour_loss(learned.classifier, learned.codes, groups)
        return terms

    @torch.no_grad()
    def finish(self) -> Membership:
        surfels = self.scene.surfels().detach()
        self.learned.say_right_pixels(surfels, self.ranks)
        shares = identity_codes.probabilities(self.learned.classifier, self.learned.codes)
        masks = {
            class_id: identity_codes.members(shares, rank, surfels.means, self.options.threshold, self.options.hull)
            for rank, class_id in enumerate(self.ranks.ids.tolist())
            if class_id != 0
        }
        return Membership.of_masks(masks, self.scene.class_ids())
