"""The pyramid of photos: how much smaller than whole they are at each step of the base."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beags_plugin.plugin.options.schedule import PhaseSchedule
from beags_plugin.system.errors import UserError

LEAST_SIDE = 32  # pixels: the shorter side of a photo never falls below this by the pyramid; SSIM's window has 11


@dataclass(frozen=True)
class PyramidConfig:
    """Options of training the base on small photos first, which takes less time a step."""

    start: float = 1.0
    """Factor by which the photos of the first step are smaller than whole; 1 trains on whole ones throughout."""
    until: float = 0.5
    """Share of the base after which photos are whole."""
    levels: int = 2
    """Number of smaller sizes, all for as many steps, each larger than the one before by the same factor: with a start
    of 4, a quarter and a half for 2; more come nearer to a smooth growth."""

    def check(self) -> None:
        """Raise ``UserError`` for a value with which training cannot work."""
        if not 1.0 <= self.start < math.inf:
            raise UserError(f"pyramid.start is {self.start}: give 1 (whole photos) or more.")
        if not 0.0 <= self.until <= 1.0:
            raise UserError(f"pyramid.until is {self.until}: give a share of the base, 0 to 1.")
        if self.levels < 1:
            raise UserError(f"pyramid.levels is {self.levels}: give a number of sizes, 1 or more.")

    def factor(self, step: int, schedule: PhaseSchedule) -> float:
        """Return the factor by which photos are smaller than whole at ``step`` (from 0) of a run; 1 after the base.

        A base that only polishes a trained scene sees whole photos.
        """
        end = self.until * schedule.base_steps
        if self.start == 1.0 or schedule.warm or step >= end:
            return 1.0
        level = int(step * self.levels / end)
        return self.start ** (1.0 - level / self.levels)


def small_size(width: int, height: int, factor: float) -> tuple[int, int]:
    """Return width and height of a photo that is to be ``factor`` times smaller, pixels; see ``LEAST_SIDE``."""
    factor = max(min(factor, min(width, height) / LEAST_SIDE), 1.0)
    return max(math.floor(width / factor + 0.5), 1), max(math.floor(height / factor + 0.5), 1)
