"""Forecasts of the trials of an experiment from finished trials of the same kind."""

from __future__ import annotations

import json
import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.engines.interface import Needs
from beags_benchmarks.experiments.scenes import SceneSize
from beags_benchmarks.experiments.trials import Trial, VariantTrial

BASE = "base"  # kind of trials from which others start
TEMPORARY_BYTES = 18  # disk per training pixel during preparation: depth 4, lifted pixels 6, votes 8 (notes/poses.md)
PROGRAM_MB = 1000.0  # memory for a trial of an unknown kind
PIXEL_BYTES = 8  # additional memory per training pixel: photos 3, masks 2, room for the rest


@dataclass(frozen=True)
class Cost:
    """Cost of a finished trial: seconds of wall time, busy cores (None if unknown), peak memory, the part of it without
    the loaded program, and the size of its folder, MB."""

    seconds: float
    cores: float | None
    memory_mb: float
    own_memory_mb: float
    disk_mb: float
    pixels: int


@dataclass(frozen=True)
class SceneForecast:
    """The forecast for a scene. trials, done: numbers of trials. unknown: kinds of trials of which none has finished.

    hours: time of trials that are not done. memory_mb: peak memory. disk_mb: disk, including ``temporary_mb``, which is
    freed again. All are without unknown kinds.
    """

    title: str
    size: SceneSize
    trials: int
    done: int
    hours: float
    memory_mb: float
    disk_mb: float
    temporary_mb: float
    unknown: tuple[str, ...]


class Forecast:
    """Forecasts trials from finished ones of their kind: a variant's refinements, or bases with the same options.

    sizes: sizes of scenes by name. folder: folder of all trials. Time and disk are assumed to be proportional to the
    number of training pixels.
    """

    def __init__(self, runs: Sequence[VariantTrial], sizes: Mapping[str, SceneSize], folder: Path) -> None:
        self._sizes, self._folder = sizes, folder
        self._kinds: dict[str, tuple[tuple[str, str], Trial]] = {}
        for run in runs:
            for trial in run.trials:
                assert trial.base is not None
                options = {key: repr(value) for key, value in trial.base.overrides.items()}
                self._kinds[trial.base.digest] = (BASE, json.dumps(options, sort_keys=True)), trial.base
                self._kinds[trial.digest] = (run.variant.name, ""), trial
        self._costs: dict[str, Cost] = {}  # costs of finished trials by digest

    def scenes(self, titles: Mapping[str, str] | None = None) -> list[SceneForecast]:
        """Return a forecast for each scene; titles: name to title, if not the name."""
        known = self._known({kind for kind, _ in self._kinds.values()})
        return [self._scene(name, (titles or {}).get(name, name), known) for name in self._sizes]

    def needs(self, trial: Trial) -> Needs:
        """Return the expected needs of a trial; memory is the largest measured, scaled up for more training pixels."""
        pixels = self._sizes[trial.scene.name].pixels
        kind = self._kinds[trial.digest][0]
        if not (costs := self._known([kind]).get(kind, [])):
            return Needs(None, PROGRAM_MB + PIXEL_BYTES * pixels / 1e6)
        larger = [max(pixels / cost.pixels - 1.0, 0.0) for cost in costs]
        memory = max(cost.memory_mb + cost.own_memory_mb * more for cost, more in zip(costs, larger, strict=True))
        cores = [cost.cores for cost in costs if cost.cores is not None]
        return Needs(max(1, math.ceil(max(cores) - 0.25)) if cores else None, memory)

    def _known(self, kinds: Container[tuple[str, str]]) -> dict[tuple[str, str], list[Cost]]:
        """Return the costs of finished trials of these kinds, including trials that finished since the last call."""
        known: dict[tuple[str, str], list[Cost]] = {}
        for digest, (kind, trial) in self._kinds.items():
            if kind in kinds and digest not in self._costs:
                pixels = self._sizes[trial.scene.name].pixels
                if (cost := _cost(self._folder / trial.folder_name, pixels)) is not None:
                    self._costs[digest] = cost
            if kind in kinds and digest in self._costs:
                known.setdefault(kind, []).append(self._costs[digest])
        return known

    def _scene(self, name: str, title: str, known: Mapping[tuple[str, str], Sequence[Cost]]) -> SceneForecast:
        size = self._sizes[name]
        own = {digest: kind for digest, (kind, trial) in self._kinds.items() if trial.scene.name == name}
        to_do = [kind for digest, kind in own.items() if digest not in self._costs]
        forecast = [kind for kind in to_do if kind in known]
        scaled = [_mean(known[kind], size.pixels) for kind in forecast]
        refines = any(kind[0] != BASE for kind in to_do)
        temporary = TEMPORARY_BYTES * size.pixels / 1e6 if refines else 0.0
        return SceneForecast(
            title,
            size,
            len(own),
            len(own) - len(to_do),
            sum(seconds for seconds, _ in scaled) / 3600.0,
            max((cost.memory_mb for kind in forecast for cost in known[kind]), default=0.0),
            sum(disk for _, disk in scaled) + temporary,
            temporary,
            tuple(dict.fromkeys(kind[0] for kind in to_do if kind not in known)),
        )


def _cost(folder: Path, pixels: int) -> Cost | None:
    """Return the cost of the trial in ``folder``; None if it has not finished."""
    try:
        result: Mapping[str, Any] = json.loads((folder / "result.json").read_text())
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        seconds = sum(result["seconds"].values())
        cpu = result.get("cpu_seconds")
        cores = cpu / seconds if cpu is not None and seconds > 0 else None
        memory = float(result["peak_memory_mb"])
        return Cost(seconds, cores, memory, float(result.get("own_memory_mb", memory)), size / 1e6, pixels)
    except (OSError, ValueError, KeyError):
        return None


def _mean(costs: Sequence[Cost], pixels: int) -> tuple[float, float]:
    """Return the mean seconds and MB on disk, scaled to ``pixels`` training pixels."""
    scale = [pixels / cost.pixels for cost in costs]
    seconds = sum(cost.seconds * factor for cost, factor in zip(costs, scale, strict=True)) / len(costs)
    return seconds, sum(cost.disk_mb * factor for cost, factor in zip(costs, scale, strict=True)) / len(costs)
