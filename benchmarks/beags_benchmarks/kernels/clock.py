"""The two clocks of a measurement."""

from __future__ import annotations

import time
from dataclasses import dataclass


@dataclass(frozen=True)
class Seconds:
    """Seconds of two clocks. wall: elapsed time. cpu: time of all threads of this process, whatever else runs."""

    wall: float
    cpu: float

    @classmethod
    def now(cls) -> Seconds:
        return cls(time.perf_counter(), time.process_time())

    def __sub__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall - other.wall, self.cpu - other.cpu)

    def __add__(self, other: Seconds) -> Seconds:
        return Seconds(self.wall + other.wall, self.cpu + other.cpu)

    def ms(self) -> tuple[float, float]:
        """Return wall and CPU time in milliseconds."""
        return 1e3 * self.wall, 1e3 * self.cpu
