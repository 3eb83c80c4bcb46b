"""Time of a run: its stages, and an estimate of how long it takes."""

from __future__ import annotations

import time
from typing import Any

from beags_plugin.system.progress import say

QUICKEST = "beags-tiny"
QUICKER = f"Quicker: ns-train {QUICKEST}, or end the command with: beags-data --downscale-factor 2."
LONG_RUN_SECONDS = 20 * 60  # If a run is expected to take longer, the message names a quicker preset.
ESTIMATE_STEPS = (20, 120)  # The estimate is the mean step between these, after warm-up.


class Estimate:
    """The expected time of ``steps`` steps of a method, printed once.

    chosen: whether the user could still choose another method, as in a new run; then a quicker one is named.
    """

    def __init__(self, method: str, steps: int, chosen: bool = True) -> None:
        self._steps = steps
        self._quicker = f" {QUICKER}" if chosen and method != QUICKEST else ""
        self._from = 0.0
        say(f"{method}: {steps} steps; a line after {ESTIMATE_STEPS[1]} tells how long they take.{self._quicker}")

    def before_step(self, done: int) -> None:
        """Measure the time before a step. done: steps of this process so far."""
        first, last = ESTIMATE_STEPS
        if done == first:
            self._from = time.perf_counter()
        if done == last:
            self._report((time.perf_counter() - self._from) / (last - first))

    def _report(self, seconds_per_step: float) -> None:
        left = self._steps * seconds_per_step
        message = (
            f"About {_duration(left)} for {self._steps} steps at the present speed "
            f"({1000 * seconds_per_step:.0f} ms a step; it slows down as Gaussians are added)."
        )
        if left > LONG_RUN_SECONDS:
            message += self._quicker
        say(message)


class StageSeconds:
    """The wall times of base training, each preparation stage and refinement; a resumed run adds to them."""

    def __init__(self) -> None:
        self._started = time.perf_counter()
        self._former: dict[str, float] = {}
        self._stages: dict[str, float] = {}
        self._preparing = 0.0
        self._refining_since = 0.0

    def start(self) -> None:
        """Begin to count."""
        self._started = time.perf_counter()

    def prepared(self, stages: dict[str, float], seconds: float) -> None:
        """Begin to count refinement, after a preparation of ``seconds`` with the seconds of its stages."""
        self._preparing, self._stages = seconds, dict(stages)
        self._refining_since = time.perf_counter()

    def refining(self) -> None:
        """Begin to count refinement without a preparation in this process."""
        self._refining_since = time.perf_counter()

    def total(self) -> dict[str, float]:
        """Return seconds by name."""
        now = time.perf_counter()
        refining = now - self._refining_since if self._refining_since > 0 else 0.0
        base = now - self._started - self._preparing - refining
        own = {"base training": base, **self._stages, "refinement": refining}
        names = [name for name in {**self._former, **own} if name != "refinement"]
        return {name: self._former.get(name, 0.0) + own.get(name, 0.0) for name in [*names, "refinement"]}

    def state(self) -> dict[str, Any]:
        """Return the seconds by name; see ``resumable.Resumable``."""
        return self.total()

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``."""
        self._former = dict(state)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
