"""How long a run takes: what is said while it trains, and the seconds of its parts in the final report."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from nerfstudio.utils.rich_utils import CONSOLE

if TYPE_CHECKING:
    from beags_plugin.plugin.model import BeagsModel

QUICKER = "Quicker: ns-train beags-tiny, or end the command with: beags-data --downscale-factor 2."
LONG_RUN_SECONDS = 20 * 60  # a run that is expected to take longer says which preset is quicker
ESTIMATE_STEPS = (20, 120)  # the estimate is the mean step between these: after warm-up, soon enough to matter


class Estimate:
    """Says once how long ``steps`` steps of a method will take."""

    def __init__(self, method: str, steps: int) -> None:
        self._steps = steps
        self._from = 0.0
        CONSOLE.print(
            f"{method}: {steps} steps; how long they take is said after {ESTIMATE_STEPS[1]} of them. {QUICKER}",
            highlight=False,
        )

    def before_step(self, done: int) -> None:
        """To be told before every step how many this process has done."""
        first, last = ESTIMATE_STEPS
        if done == first:
            self._from = time.perf_counter()
        if done == last:
            self._say((time.perf_counter() - self._from) / (last - first))

    def _say(self, seconds_per_step: float) -> None:
        left = self._steps * seconds_per_step
        message = (
            f"About {_duration(left)} for {self._steps} steps at the present speed "
            f"({1000 * seconds_per_step:.0f} ms a step; it slows down as Gaussians are added)."
        )
        if left > LONG_RUN_SECONDS:
            message += f" {QUICKER}"
        CONSOLE.print(message, highlight=False)


class StageSeconds:
    """Wall time of base training, each preparation stage and refinement; a run that was broken off counts on."""

    def __init__(self, model: BeagsModel) -> None:
        self.model = model
        self._started = time.perf_counter()
        self._former: dict[str, float] = {}

    def total(self) -> dict[str, float]:
        """Seconds by name."""
        model, now = self.model, time.perf_counter()
        refining = now - model.refining_since if model.refining_since > 0 else 0.0
        base = now - self._started - model.preparing_seconds - refining
        own = {"base training": base, **model.prepared_seconds, "refinement": refining}
        names = [name for name in {**self._former, **own} if name != "refinement"]
        return {name: self._former.get(name, 0.0) + own.get(name, 0.0) for name in [*names, "refinement"]}

    def state(self) -> dict[str, Any]:
        """See ``training_state.Part``."""
        return self.total()

    def restore(self, state: dict[str, Any]) -> None:
        """See ``training_state.Part``."""
        self._former = dict(state)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
