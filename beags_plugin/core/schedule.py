"""Steps of the two phases, and the schedules of the learning rates (method, sections 1 and 7)."""

from __future__ import annotations

import math
from dataclasses import dataclass

POLISH_SCHEDULE_FROM = 0.5  # A base that starts from a trained scene repeats the second half of the schedule.
REFINE_SCHEDULE_FROM = 0.9  # Refinement repeats the learning rates of the base's last tenth (27,000..30,000).


@dataclass(frozen=True)
class PhaseSchedule:
    """Steps of the two phases: base is [0, base_steps), refinement [base_steps, base_steps + refine_steps).

    stated_for: length of the base for which the schedule's other steps are stated; 0 if they are stated for this one.
    warm: the base starts from a trained scene and only polishes it.
    """

    base_steps: int
    refine_steps: int
    stated_for: int = 0
    warm: bool = False

    @property
    def scale(self) -> float:
        """Factor from stated steps to those of this run; 1 where there is no base to train."""
        return self.base_steps / self.stated_for if self.base_steps > 0 and self.stated_for > 0 else 1.0

    def scaled(self, steps: int) -> int:
        """Scale a stated step (or interval: at least 1) to this run; 0 stays 0."""
        return max(round(steps * self.scale), 1) if steps > 0 else steps

    @property
    def total(self) -> int:
        """Steps of the whole run."""
        return self.base_steps + self.refine_steps

    def refining(self, step: int) -> bool:
        """Return whether ``step`` belongs to refinement."""
        return step >= self.base_steps

    def progress(self, step: int) -> float:
        """Return the position in the base's learning-rate schedule, 0..1; refinement from 0.9, polish from 0.5."""
        if not self.refining(step):
            first = POLISH_SCHEDULE_FROM if self.warm else 0.0
            return first + (1.0 - first) * step / max(self.base_steps, 1)
        done = (step - self.base_steps) / max(self.refine_steps, 1)
        return REFINE_SCHEDULE_FROM + (1.0 - REFINE_SCHEDULE_FROM) * min(done, 1.0)


def log_linear(first: float, last: float, progress: float) -> float:
    """Interpolate the logarithm of a learning rate at ``progress`` (0..1)."""
    return math.exp(math.log(first) * (1.0 - progress) + math.log(last) * progress)
