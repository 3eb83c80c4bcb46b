"""Gaussian Grouping as a refiner: codes and their classifier learn while the base trains on (``identity_codes``).

The source learns them with the scene, from scratch. Here they join a trained base, whose number of Gaussians stays, at
the refinement's rates: those of the base, for positions those of its last tenth.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.own_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.rasterizers.rendering import draw_features, surfel_inputs
from beags_plugin.refiners import identity_codes
from beags_plugin.system import processes
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

LEAST_RIGHT = 0.97  # of the labelled training pixels: with less, codes and classifier have not learned the masks
NEIGHBOURS, CODES, CLASSIFIER = range(3)  # purposes of random numbers


@dataclass(frozen=True)
class GaussianGroupingRefiner(Refiner):
    """Cuts every object out by the classes of codes in space; objects may overlap.

    threshold, hull: see ``identity_codes.members``.
    """

    threshold: float = identity_codes.THRESHOLD
    hull: bool = identity_codes.HULL

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
        self.scene = scene
        self.options = options
        means = scene.surfels().means
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=means.device))
        codes = identity_codes.initial_codes(len(means), scene.generator(0, CODES))
        self.codes = codes.to(means.device).requires_grad_()
        generator = scene.generator(0, CLASSIFIER)
        self.classifier = identity_codes.initial_classifier(len(self.ranks), generator).to(means.device)
        self.learned = [self.codes, *self.classifier.parameters()]
        factor = identity_codes.rate_factor(scene.steps)
        self.adam = torch.optim.Adam(
            [
                {"params": self.learned[:1], "lr": factor * identity_codes.CODE_RATE, "eps": 1e-15},
                {"params": self.learned[1:], "lr": factor * identity_codes.CLASSIFIER_RATE, "eps": 1e-8},
            ]
        )

    def before_step(self, step: int) -> Edit | None:
        self.adam.zero_grad()
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        terms = base()
        if inputs.labels is not None and bool((inputs.labels != IGNORE).any()):  # a view without a mask is all IGNORE
            labels = self.ranks.ranked_labels(inputs.labels)
            drawn = self._drawn(inputs.surfels, inputs.camera)
            terms["identities"] = identity_codes.pixel_loss(self.classifier, drawn, labels)
        if step % identity_codes.INTERVAL == 0:
            groups = identity_codes.nearest_in_space(inputs.surfels.means, self.scene.generator(step, NEIGHBOURS))
            terms["neighbours"] = identity_codes.neighbour_loss(self.classifier, self.codes, groups)
        return terms

    def _drawn(self, surfels: Surfels, camera: Camera) -> Tensor:
        inputs = surfel_inputs(surfels, camera, sh_degree=0)  # whose colours give way to the codes
        return draw_features(self.scene.rasterizer, inputs, self.codes, camera, self.scene.settings)

    def after_step(self, step: int) -> Edit | None:
        if processes.in_any(self.codes.grad is not None):  # not where no view had a mask
            for values in self.learned:
                values.grad = torch.zeros_like(values) if values.grad is None else values.grad
            processes.average(values.grad for values in self.learned if values.grad is not None)
            self.adam.step()
        return None

    @torch.no_grad()
    def finish(self) -> Membership:
        surfels = self.scene.surfels().detach()
        right = self._right_pixels(surfels)
        lesson = "" if right >= LEAST_RIGHT else f", below {LEAST_RIGHT:.0%}: train longer (refine_steps)"
        say(f"  codes: {right:.1%} of the labelled pixels of training views get their class{lesson}")
        shares = identity_codes.probabilities(self.classifier, self.codes)
        masks = {
            class_id: identity_codes.members(shares, rank, surfels.means, self.options.threshold, self.options.hull)
            for rank, class_id in enumerate(self.ranks.ids.tolist())
            if class_id != 0
        }
        return Membership.of_masks(masks, self.scene.class_ids())

    def _right_pixels(self, surfels: Surfels) -> float:
        """Return the share of labelled pixels of all training views whose drawn code gets their class."""
        found = torch.zeros(2, dtype=torch.int64)
        with self.scene.stage("Checking identities") as progress:
            for index, camera in enumerate(self.scene.cameras):
                if (labels := self.scene.labels[index]) is not None:
                    logits = self.classifier(self._drawn(surfels, camera))
                    labels = self.ranks.ranked_labels(labels.to(logits.device))
                    found += torch.stack(identity_codes.right_pixels(logits, labels)).cpu()
                progress(index + 1, len(self.scene.cameras))
        return int(found[0]) / max(int(found[1]), 1)

    def state(self) -> dict[str, Any]:
        return {
            "codes": self.codes.detach(),
            "classifier": self.classifier.state_dict(),
            "adam": self.adam.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        with torch.no_grad():
            self.codes.copy_(state["codes"])
        self.classifier.load_state_dict(state["classifier"])
        self.adam.load_state_dict(state["adam"])
