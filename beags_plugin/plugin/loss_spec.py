"""A term of the training loss as configs list it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from beags_plugin.losses import LOSSES
from beags_plugin.losses.base import Loss
from beags_plugin.plugin.schedule import PhaseSchedule


@dataclass
class LossSpec:
    """One term of the training loss, as a config lists it."""

    weight: float = 1.0
    """Factor in the sum; 0 switches the term off."""
    phase: Literal["base", "refine", "both"] = "both"
    """Where the term may act."""
    start: int = 0
    """First step of the term: of the run, stated for a base of schedule_steps; or, for phase "refine", of the
    refinement, as it is."""
    options: dict[str, bool | int | float] = field(default_factory=dict)
    """Options of the loss itself, e.g. ssim_weight or samples."""

    def build(self, name: str, schedule: PhaseSchedule) -> Loss:
        """The loss, with its steps made absolute."""
        first = schedule.base_steps + self.start if self.phase == "refine" else schedule.scaled(self.start)
        if self.phase != "refine" and (schedule.base_steps == 0 or schedule.warm):
            first = 0  # the base was trained elsewhere: its terms have long started
        last = schedule.base_steps if self.phase == "base" else None
        return LOSSES.get(name)(weight=self.weight, start=first, stop=last, **self.options)
