"""A term of the training loss as configs list it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Literal, get_args

from tyro.conf import Suppress

from beags_plugin.losses import LOSSES
from beags_plugin.losses.base import Loss
from beags_plugin.options.schedule import PhaseSchedule
from beags_plugin.system.errors import UserError, check_choice

Phase = Literal["base", "refine", "both"]


@dataclass
class LossSpec:
    """One term of the training loss, as a config lists it; presets alone set ``phase`` and ``start``."""

    weight: float = 1.0
    """Factor of the term in the sum; 0 switches it off."""
    phase: Suppress[Phase] = "both"
    """Phase in which the term may act."""
    start: Suppress[int] = 0
    """First step of the term: a step of the run, stated for a base of schedule_steps; with phase "refine", a step of
    the refinement, which is never scaled."""
    options: dict[str, bool | int | float] = field(default_factory=dict)
    """Options of the loss itself. occupancy: samples, points per Gaussian and step (Z); background, the share of the
    weight on the background's Gaussians, 1 as in the paper. silhouette: objects, the number rendered in each step;
    seen, the number of the 27 voxels around a pixel of another object that, seen as the object's own, exempt it; 0:
    never."""

    def build(self, name: str, schedule: PhaseSchedule) -> Loss:
        """Build the loss, with absolute steps; raises ``UserError`` for a wrong value."""
        kind = LOSSES.get(name)
        if not 0.0 <= self.weight < math.inf:
            raise UserError(f"the loss {name} has the weight {self.weight}: give 0 (off) or more.")
        check_choice(self.phase, get_args(Phase), "phase", f" of the loss {name}")
        if self.start < 0:
            raise UserError(f"the loss {name} starts at step {self.start}: give 0 or more.")
        known = [field.name for field in fields(kind) if field.name not in ("weight", "start", "stop")]
        for option in self.options:
            check_choice(option, known, "option", f" of the loss {name}")
        first = schedule.base_steps + self.start if self.phase == "refine" else schedule.scaled(self.start)
        if self.phase != "refine" and (schedule.base_steps == 0 or schedule.warm):
            first = 0  # The base was trained elsewhere, so its terms have long started.
        last = schedule.base_steps if self.phase == "base" else None
        return kind(weight=self.weight, start=first, stop=last, **self.options)
