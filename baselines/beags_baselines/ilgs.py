"""ILGS as a refiner: identity codes and their classifier learn while the base trains on, but not from doubtful pixels.

Jang, Kim, "Identity-aware Language Gaussian Splatting for Open-vocabulary 3D Semantic Segmentation", ICCV 2025. Codes
and classifier are those of Gaussian Grouping (``identity_codes``), with 256 outputs and without its term of neighbours.
With CE(u) the cross-entropy of a labelled pixel, and t from 0 to 1 over the run,

    L = 1 / ln 256 x mean over labelled pixels of (CE(u) if CE(u) <= (2 - t) mean CE, else 0),

which reaches codes, classifier and, through the blending weights, the geometry. The bound is a constant of the step.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beags_baselines import identity_codes
from beags_baselines.learned_codes import LearnedCodes
from beags_baselines.object_codebook import code_entropy, members_by_softmax
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

OUTPUTS = 256  # of the classifier; more if there are more classes
WEIGHT = 1.0
LEAST_IN_HULL = 4


def trusted_mean(entropies: Tensor, labelled: Tensor, share: float) -> Tensor:
    """Return L. entropies: [P], CE, 0 where unlabelled. labelled: [P] bool, one at least. share: t, of the steps."""
    count = labelled.sum()
    bound = ordered_sum(entropies.detach()) / count * (2.0 - share)
    return ordered_sum(torch.where(entropies > bound, 0.0, entropies)) / count / math.log(identity_codes.NORMALISER)


def inside_hull(means: Tensor, chosen: Tensor) -> Tensor:
    """Return [N] bool, as ``identity_codes.inside_hull``, but of four at least, and of outliers too if no four stay."""
    return identity_codes.inside_hull(means, chosen, LEAST_IN_HULL, else_all=True)


@dataclass(frozen=True)
class IlgsRefiner(Refiner):
    """Cuts every object out by the classes of codes in space; objects may overlap."""

    weight: float = WEIGHT
    """Weight of the cross-entropy; 0: the base trains on."""
    threshold: float = identity_codes.THRESHOLD
    """Least probability of an object."""
    hull: bool = identity_codes.HULL
    """Gaussians inside the object's hull join it."""

    def __post_init__(self) -> None:
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold:g}: give a probability, from 0 to below 1.")
        if not 0.0 <= self.weight < math.inf:
            raise UserError(f"weight is {self.weight:g}: give the weight of a loss, 0 or more.")

    def steps(self, asked: int, views: int, objects: int) -> int:
        return asked

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return IlgsTraining(scene, self)


class IlgsTraining(OwnTraining):
    """Trains the scene, a code of each Gaussian, and the classifier of drawn codes."""

    def __init__(self, scene: TrainedScene, options: IlgsRefiner) -> None:
        self.scene, self.options = scene, options
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=scene.surfels().means.device))
        self.outputs = max(OUTPUTS, len(self.ranks))
        self.learned = LearnedCodes(scene, self.outputs)

    def before_step(self, step: int) -> Edit | None:
        self.learned.adam.zero_grad()
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms = base()
        if inputs.labels is None or self.options.weight == 0:
            return terms
        labels = self.ranks.ranked_labels(inputs.labels).flatten()
        labelled = labels != IGNORE
        if not bool(labelled.any()):  # a view without a mask
            return terms
        drawn = self.learned.drawn(inputs.surfels, inputs.camera).flatten(0, 1)
        entropies = code_entropy(self.learned.classifier, drawn, labels, self.outputs)
        share = (step + 1) / self.scene.steps
        return {**terms, "identities": self.options.weight * trusted_mean(entropies, labelled, share)}

    def after_step(self, step: int) -> Edit | None:
        self.learned.step()
        return None

    @torch.no_grad()
    def finish(self) -> Membership:
        surfels, ids, learned = self.scene.surfels().detach(), self.ranks.ids.tolist(), self.learned
        learned.say_right_pixels(surfels, self.ranks)
        owner = torch.full((self.outputs,), -1, device=surfels.means.device)
        owner[: len(ids)] = torch.arange(len(ids), device=owner.device)
        found = members_by_softmax(learned.classifier, learned.codes, owner, len(ids), self.options.threshold)
        if self.options.hull:
            hulls = {rank: inside_hull(surfels.means, chosen) for rank, chosen in found.items()}
            without = [self.scene.names[ids[rank]] for rank, inside in hulls.items() if not bool(inside.any())]
            if without:
                say(f"  no hull, for want of Gaussians or as all lie in a plane: {', '.join(without)}")
            found = {rank: chosen | hulls[rank] for rank, chosen in found.items()}
        return Membership.of_masks({ids[rank]: chosen for rank, chosen in found.items()}, self.scene.class_ids())

    def figures(self) -> Mapping[str, float]:
        return self.learned.figures

    def state(self) -> dict[str, Any]:
        return self.learned.state()

    def restore(self, state: dict[str, Any]) -> None:
        self.learned.restore(state)
