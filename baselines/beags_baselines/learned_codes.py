"""Codes of Gaussians and the classifier of drawn codes while they learn: what the refiners that train them share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from beags_baselines import identity_codes
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.rasterizers.rendering import draw_features, surfel_inputs
from beags_plugin.system.progress import say

LEAST_RIGHT = 0.97  # of the labelled training pixels: with less, codes and classifier have not learned the masks
CODES, CLASSIFIER = 1, 2  # purposes of random numbers; 0 is for the refiner's own


class LearnedCodes:
    """A code of each Gaussian [N, 16], a classifier with some number of outputs, and an Adam for both.

    Short runs learn faster: see ``identity_codes.rate_factor``. ``scene`` must keep its number of Gaussians. figures:
    for the run's report; "labelled_share" once ``say_right_pixels`` has found it.
    """

    def __init__(self, scene: TrainedScene, outputs: int, bias: bool = True) -> None:
        self.scene = scene
        means = scene.surfels().means
        codes = identity_codes.initial_codes(len(means), scene.generator(0, CODES))
        self.codes = codes.to(means.device).requires_grad_()
        generator = scene.generator(0, CLASSIFIER)
        self.classifier = identity_codes.initial_classifier(outputs, generator, bias).to(means.device)
        self.learned = [self.codes, *self.classifier.parameters()]
        self.figures: dict[str, float] = {}
        factor = identity_codes.rate_factor(scene.steps)
        self.adam = torch.optim.Adam(
            [
                {"params": self.learned[:1], "lr": factor * identity_codes.CODE_RATE, "eps": 1e-15},
                {"params": self.learned[1:], "lr": factor * identity_codes.CLASSIFIER_RATE, "eps": 1e-8},
            ]
        )

    def drawn(self, surfels: Surfels, camera: Camera) -> Tensor:
        """Return the codes as a view sees them, [H, W, 16]; gradients reach the surfels if they have any."""
        inputs = surfel_inputs(surfels, camera, sh_degree=0)  # whose colours give way to the codes
        return draw_features(self.scene.rasterizer, inputs, self.codes, camera, self.scene.settings)

    def step(self) -> None:
        """Let both learn from the gradients of a step, if there are any."""
        if any(values.grad is not None for values in self.learned):  # not where no view had a mask
            for values in self.learned:
                values.grad = torch.zeros_like(values) if values.grad is None else values.grad
            self.adam.step()

    def say_right_pixels(self, surfels: Surfels, ranks: ClassRanks) -> None:
        """Print and keep the share of labelled pixels of all training views whose drawn code gets their class."""
        found, scene = torch.zeros(2, dtype=torch.int64), self.scene
        with torch.no_grad(), scene.stage("Checking identities") as progress:
            for index, camera in enumerate(scene.cameras):
                if (labels := scene.labels[index]) is not None:
                    logits = self.classifier(self.drawn(surfels, camera))
                    labels = ranks.ranked_labels(labels.to(logits.device))
                    found += torch.stack(identity_codes.right_pixels(logits, labels)).cpu()
                progress(index + 1, len(scene.cameras))
        right = self.figures["labelled_share"] = int(found[0]) / max(int(found[1]), 1)
        lesson = "" if right >= LEAST_RIGHT else f", below {LEAST_RIGHT:.0%}: train longer (refine_steps)"
        say(f"  codes: {right:.1%} of the labelled pixels of training views get their class{lesson}")

    def state(self) -> dict[str, Any]:
        """Return what decides how they go on."""
        return {
            "codes": self.codes.detach(),
            "classifier": self.classifier.state_dict(),
            "adam": self.adam.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on as those that gave ``state`` would have."""
        with torch.no_grad():
            self.codes.copy_(state["codes"])
        self.classifier.load_state_dict(state["classifier"])
        self.adam.load_state_dict(state["adam"])
