"""ILGS as a refiner: identity codes and their classifier are trained with the scene, except on doubtful pixels.

Jang, Kim, "Identity-aware Language Gaussian Splatting for Open-vocabulary 3D Semantic Segmentation", ICCV 2025. Codes
and classifier are those of Gaussian Grouping (``identity_codes``), with 256 outputs and without its term of neighbours.
With CE(u) the cross-entropy of a labelled pixel, and t from 0 to 1 over the run,

    L = 1 / ln 256 x mean over labelled pixels of (CE(u) if CE(u) <= (2 - t) mean CE, else 0),

which reaches codes, classifier and, through the blending weights, the geometry. The bound is a constant of the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_baselines import identity_codes
from beags_baselines.learned_codes import CodeTraining
from beags_baselines.object_codebook import code_entropy, members_by_softmax
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

OUTPUTS = 256  # least number of outputs of the classifier
WEIGHT = 1.0
LEAST_IN_HULL = 4


def trusted_mean(entropies: Tensor, labelled: Tensor, share: float) -> Tensor:
    """Return L. entropies: [P], CE, 0 if unlabelled. labelled: [P] bool, not all False. share: t of the run."""
    count = labelled.sum()
    bound = ordered_sum(entropies.detach()) / count * (2.0 - share)
    return ordered_sum(torch.where(entropies > bound, 0.0, entropies)) / count / math.log(identity_codes.NORMALISER)


def inside_hull(means: Tensor, chosen: Tensor) -> Tensor:
    """Return ``identity_codes.inside_hull`` with ILGS' choices: four points suffice, and outliers may be among them."""
    return identity_codes.inside_hull(means, chosen, LEAST_IN_HULL, else_all=True)


@dataclass(frozen=True)
class IlgsRefiner(Refiner):
    """Takes objects out by the classes of the Gaussians' codes; objects may overlap."""

    weight: float = WEIGHT
    """Weight of the cross-entropy; 0 trains the base only."""
    threshold: float = identity_codes.THRESHOLD
    """Least probability of an object."""
    hull: bool = identity_codes.HULL
    """Gaussians inside the object's hull join it."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a probability, from 0 to below 1.")
        if not 0.0 <= self.weight < math.inf:
            raise UserError(f"weight is {self.weight:g}: give the weight of a loss, 0 or more.")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return IlgsTraining(scene, self)


class IlgsTraining(CodeTraining):
    """Trains the scene, a code of each Gaussian, and the classifier of rendered codes."""

    def __init__(self, scene: TrainedScene, options: IlgsRefiner) -> None:
        self.outputs = max(OUTPUTS, len(scene.names))
        super().__init__(scene, self.outputs)
        self.options = options

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms = base()
        if inputs.labels is None or self.options.weight == 0:
            return terms
        labels = ranked_labels(self.ranks, inputs.labels).flatten()
        labelled = labels != IGNORE
        if not bool(labelled.any()):  # a view without a mask
            return terms
        rendered = self.learned.rendered(inputs.surfels, inputs.camera).flatten(0, 1)
        entropies = code_entropy(self.learned.classifier, rendered, labels, self.outputs)
        share = (step + 1) / self.scene.steps
        return {**terms, "identities": self.options.weight * trusted_mean(entropies, labelled, share)}

    @torch.no_grad()
    def finish(self) -> Membership:
        surfels, ids, learned = self.scene.surfels().detach(), self.ranks.ids.tolist(), self.learned
        learned.say_right_pixels(surfels, self.ranks)
        owner = torch.full((self.outputs,), -1, device=surfels.means.device)
        owner[: len(ids)] = torch.arange(len(ids), device=owner.device)
        objects = members_by_softmax(learned.classifier, learned.codes, owner, len(ids), self.options.threshold)
        if self.options.hull:
            hulls = {rank: inside_hull(surfels.means, chosen) for rank, chosen in objects.items()}
            without = [self.scene.names[ids[rank]] for rank, inside in hulls.items() if not bool(inside.any())]
            if without:
                say(f"  no hull, since there are too few Gaussians or all lie in a plane: {', '.join(without)}")
            objects = {rank: chosen | hulls[rank] for rank, chosen in objects.items()}
        return Membership.of_masks({ids[rank]: chosen for rank, chosen in objects.items()}, self.scene.class_ids())
