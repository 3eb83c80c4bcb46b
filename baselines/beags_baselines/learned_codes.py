"""Training of a code for each Gaussian and of the classifier of rendered codes, shared by several refiners."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from beags_baselines import identity_codes
from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, TrainedScene
from beags_plugin.rasterizers.rendering import draw_features, surfel_inputs
from beags_plugin.system.progress import say

LEAST_RIGHT = 0.97  # share of labelled training pixels with their class below which the masks are not learned yet
CODES, CLASSIFIER = 1, 2  # purposes of random numbers; the refiner itself uses 0


class LearnedCodes:
    """A code of each Gaussian [N, 16], a classifier with ``outputs`` outputs, and an Adam for both.

    Rates are higher in short runs: see ``identity_codes.rate_factor``. ``scene`` must keep its number of Gaussians.
    figures: values for the run's report; "labelled_share" after ``say_right_pixels``.
    """

    def __init__(self, scene: TrainedScene, outputs: int, bias: bool = True) -> None:
        self.scene = scene
        means = scene.surfels().means
        codes = identity_codes.initial_codes(len(means), scene.generator(0, CODES))
        self.codes = codes.to(means.device).requires_grad_()
        generator = scene.generator(0, CLASSIFIER)
        self.classifier = identity_codes.initial_classifier(outputs, generator, bias).to(means.device)
        self.parameters = [self.codes, *self.classifier.parameters()]
        self.figures: dict[str, float] = {}
        factor = identity_codes.rate_factor(scene.steps)
        self.adam = torch.optim.Adam(
            [
                {"params": self.parameters[:1], "lr": factor * identity_codes.CODE_RATE, "eps": 1e-15},
                {"params": self.parameters[1:], "lr": factor * identity_codes.CLASSIFIER_RATE, "eps": 1e-8},
            ]
        )

    def rendered(self, surfels: Surfels, camera: Camera) -> Tensor:
        """Render the codes in a view, [H, W, 16]; surfels that require gradients get them."""
        inputs = surfel_inputs(surfels, camera, sh_degree=0)  # the codes replace the colours
        return draw_features(self.scene.rasterizer, inputs, self.codes, camera, self.scene.settings)

    def step(self) -> None:
        """Take a step of Adam if there are gradients."""
        if any(values.grad is not None for values in self.parameters):  # there are none if the view has no mask
            for values in self.parameters:
                values.grad = torch.zeros_like(values) if values.grad is None else values.grad
            self.adam.step()

    def say_right_pixels(self, surfels: Surfels, ranks: ClassRanks) -> None:
        """Print and save the share of labelled training pixels whose rendered code gets their class."""
        counts, scene = torch.zeros(2, dtype=torch.int64), self.scene
        with torch.no_grad(), scene.stage("Checking identities") as progress:
            for index, camera in enumerate(scene.cameras):
                if (labels := scene.labels[index]) is not None:
                    logits = self.classifier(self.rendered(surfels, camera))
                    labels = ranked_labels(ranks, labels.to(logits.device))
                    counts += torch.stack(identity_codes.right_pixels(logits, labels)).cpu()
                progress(index + 1, len(scene.cameras))
        right = self.figures["labelled_share"] = int(counts[0]) / max(int(counts[1]), 1)
        lesson = "" if right >= LEAST_RIGHT else f", below {LEAST_RIGHT:.0%}: train longer (refine_steps)"
        say(f"  codes: {right:.1%} of the labelled pixels of training views get their class{lesson}")

    def state(self) -> dict[str, Any]:
        """Return the state from which training continues."""
        return {
            "codes": self.codes.detach(),
            "classifier": self.classifier.state_dict(),
            "adam": self.adam.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from a former ``state()``."""
        with torch.no_grad():
            self.codes.copy_(state["codes"])
        self.classifier.load_state_dict(state["classifier"])
        self.adam.load_state_dict(state["adam"])


class CodeTraining(OwnTraining):
    """Training of ``learned``, codes and classifier; a refiner adds the terms and the objects.

    outputs: of the classifier; one for each class if None.
    """

    def __init__(self, scene: TrainedScene, outputs: int | None = None, bias: bool = True) -> None:
        self.scene = scene
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=scene.surfels().means.device))
        self.learned = LearnedCodes(scene, len(self.ranks) if outputs is None else outputs, bias)

    def before_step(self, step: int) -> Edit | None:
        self.learned.adam.zero_grad()
        return None

    def after_step(self, step: int) -> Edit | None:
        self.learned.step()
        return None

    def figures(self) -> Mapping[str, float]:
        return self.learned.figures

    def state(self) -> dict[str, Any]:
        return self.learned.state()

    def restore(self, state: dict[str, Any]) -> None:
        self.learned.restore(state)
