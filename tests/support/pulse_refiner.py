"""A refiner as another package would write it: it owns its training, splits Gaussians, and its objects overlap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from beags_plugin.core.densification import split_by_sampling
from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.system.errors import UserError, check_choice

SPEC = "pulse_refiner:PulseRefiner"
SPLIT_AT, SPLIT = 5, 10  # step of the refinement, number of Gaussians


@dataclass(frozen=True)
class PulseRefiner(Refiner):
    """Trains the scene in every second step, and adds noise to a number of each Gaussian in every step."""

    level: float = 0.0
    """Number above which a Gaussian belongs to every object."""
    object: str = ""
    """The only object; empty: all."""

    def __post_init__(self) -> None:
        if self.level > 100.0:
            raise UserError(f"level is {self.level:g}: give a number up to 100.")

    def check(self, names: Mapping[int, str]) -> None:
        if self.object:
            check_choice(self.object, [name for c, name in names.items() if c != BACKGROUND], "object")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return PulseTraining(scene, self)


class PulseTraining(OwnTraining):
    def __init__(self, scene: TrainedScene, options: PulseRefiner) -> None:
        self.scene, self.options = scene, options
        self.numbers = torch.zeros(len(scene.surfels()))

    def rates(self, step: int) -> Mapping[str, float]:
        return {"features_dc": 0.01, "scales": 0.005}

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        return base() if step % 2 else {}

    def after_step(self, step: int) -> Edit | None:
        self.numbers = self.numbers + torch.randn(len(self.numbers), generator=self.scene.generator(step))
        if step != SPLIT_AT:
            return None
        surfels = self.scene.surfels().detach()
        chosen = torch.arange(len(surfels)) < SPLIT
        edited = split_by_sampling(surfels, chosen, self.scene.generator(step, 1))
        self.numbers = self.numbers[edited.source]
        return Edit(edited)

    def finish(self) -> Membership:
        phi, everywhere = self.scene.class_ids(), self.numbers > self.options.level
        objects = [c for c, name in self.scene.names.items() if c != BACKGROUND and self.options.object in ("", name)]
        return Membership.of_masks({c: (phi == c) | everywhere for c in objects}, phi)

    def figures(self) -> Mapping[str, float]:
        return {"pulse": float(self.numbers.sum())}

    def state(self) -> dict[str, Any]:
        return {"numbers": self.numbers}

    def restore(self, state: dict[str, Any]) -> None:
        self.numbers = state["numbers"]
