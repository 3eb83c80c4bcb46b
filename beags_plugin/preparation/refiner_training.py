"""The interface of refiners that own their training: losses, rates, edits of the scene, and the objects in the end."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import Densified
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import LossInputs
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

Terms = dict[str, Tensor]
Stage = Callable[[str], Any]


@dataclass(frozen=True)
class TrainedScene:
    """What a refiner that owns its training sees of a run.

    surfels, class_ids: return the present scene, N Gaussians with gradients, and phi, [N] int32.
    cameras, labels: of the V training views; labels per view [H, W] int32. names: class id to name, background (0)
    included. steps: of the refinement. base_steps: of the base. extent: of the scene, world units. scale: units of the
    run's frame per unit of the input poses'. stage: opens a progress bar with a title.
    """

    surfels: Callable[[], Surfels]
    class_ids: Callable[[], Tensor]
    cameras: Sequence[Camera]
    labels: Sequence[Tensor]
    names: Mapping[int, str]
    rasterizer: Rasterizer
    settings: RasterSettings
    seed: int
    steps: int
    base_steps: int
    extent: float
    scale: float
    stage: Stage

    def generator(self, step: int, purpose: int = 0) -> torch.Generator:
        """Return a generator seeded by run, step and purpose, so that a resumed run draws the same numbers."""
        return torch.Generator().manual_seed((self.seed * 1_000_003 + self.base_steps + step) * 1_009 + purpose + 1)


@dataclass(frozen=True)
class Edit:
    """A change of the scene between two steps.

    edited: the Gaussians after the change; classes and Adam moments follow their sources. None leaves them as they are.
    fresh_adam: whether Adam starts anew, with moments and step count of 0.
    """

    edited: Densified | None = None
    fresh_adam: bool = False


class OwnTraining(ABC):
    """Steps of refinement that a refiner makes itself; they count from 0, and from -base_steps in a base that it joins.

    In the base only ``terms`` and ``rates`` are called: the scene grows as in any base.

    Checkpoints hold its state: ``restore(state())`` on a new object with the same scene continues bit for bit.
    """

    def rates(self, step: int) -> Mapping[str, float] | None:
        """Return the learning rate of each group of the scene, 0 for those not named; None: those of refinement."""
        return None

    def before_step(self, step: int) -> Edit | None:
        """Return what changes in the scene before a step."""
        return None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        """Return the terms of the step's loss by name; without any, no parameter changes.

        base: returns those of the base, weighted.
        """
        return base()

    def after_step(self, step: int) -> Edit | None:
        """Return what changes in the scene after the optimizer's step."""
        return None

    def last_edit(self) -> Edit | None:
        """Return what changes in the scene after all steps."""
        return None

    @abstractmethod
    def finish(self) -> Membership | None:
        """Return the Gaussians of each object, after ``last_edit``; None: their classes phi decide."""

    def figures(self) -> Mapping[str, float]:
        """Return further figures for the run's report, by name; called after ``finish``."""
        return {}

    def state(self) -> dict[str, Any]:
        """Return the state that the next steps depend on: tensors and plain values."""
        return {}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``."""
        return None
