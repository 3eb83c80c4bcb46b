"""What the trials of ``beags bench paper`` will take, by what finished ones of their kind took."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_plugin.bench.paper.on_disk import SceneOnDisk
from beags_plugin.bench.trials import Trial, VariantTrial

BASE = "base"  # the kind of the trials that others start from
TEMPORARY_BYTES = 18  # a training pixel between base and refinement: depth 4, lifted pixels 6, votes 8 (docs/data.md)


@dataclass(frozen=True)
class Cost:
    """What a finished trial took: seconds of wall time, the largest memory and the size of its folder, MB."""

    seconds: float
    memory_mb: float
    disk_mb: float
    pixels: int


@dataclass(frozen=True)
class SceneForecast:
    """The trials of a scene. trials, done: their numbers. unknown: kinds of trials of which none has finished.

    hours: of those not done. memory_mb: the largest. disk_mb: with ``temporary_mb``, which goes again. All without
    the unknown kinds.
    """

    scene: SceneOnDisk
    trials: int
    done: int
    hours: float
    memory_mb: float
    disk_mb: float
    temporary_mb: float
    unknown: tuple[str, ...]


def forecast(scenes: Sequence[SceneOnDisk], runs: Sequence[VariantTrial], folder: Path) -> list[SceneForecast]:
    """Return a forecast for each scene with trials. folder: of all trials.

    Time, and what lies on disk, are taken to grow with the training pixels; memory is the largest that was measured.
    """
    by_name = {scene.scene.name: scene for scene in scenes if scene.scene is not None}
    kinds = {trial.digest: (kind, trial) for kind, trial in _trials(runs)}
    costs: dict[str, list[Cost]] = {}
    done = set()
    for digest, (kind, trial) in kinds.items():
        if (cost := _cost(folder / trial.folder_name, by_name[trial.scene.name].pixels)) is not None:
            costs.setdefault(kind, []).append(cost)
            done.add(digest)
    found = []
    for name, scene in by_name.items():
        own = {digest: kind for digest, (kind, trial) in kinds.items() if trial.scene.name == name}
        left = [kind for digest, kind in own.items() if digest not in done]
        known = [kind for kind in left if kind in costs]
        scaled = [_mean(costs[kind], scene.pixels) for kind in known]
        temporary = TEMPORARY_BYTES * scene.pixels / 1e6 if set(left) - {BASE} else 0.0
        found.append(
            SceneForecast(
                scene,
                len(own),
                len(own) - len(left),
                sum(seconds for seconds, _ in scaled) / 3600.0,
                max((cost.memory_mb for kind in known for cost in costs[kind]), default=0.0),
                sum(disk for _, disk in scaled) + temporary,
                temporary,
                tuple(dict.fromkeys(kind for kind in left if kind not in costs)),
            )
        )
    return found


def _trials(runs: Sequence[VariantTrial]) -> list[tuple[str, Trial]]:
    found = []
    for run in runs:
        for trial in run.trials:
            assert trial.base is not None
            found += [(BASE, trial.base), (run.variant.name, trial)]
    return found


def _cost(folder: Path, pixels: int) -> Cost | None:
    """Return what the trial in ``folder`` took, or None if it has not finished."""
    try:
        result: Mapping[str, Any] = json.loads((folder / "result.json").read_text())
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        return Cost(sum(result["seconds"].values()), float(result["peak_memory_mb"]), size / 1e6, pixels)
    except (OSError, ValueError, KeyError):
        return None


def _mean(costs: Sequence[Cost], pixels: int) -> tuple[float, float]:
    """Return seconds and MB on disk for a scene of so many training pixels."""
    scale = [pixels / cost.pixels for cost in costs]
    seconds = sum(cost.seconds * factor for cost, factor in zip(costs, scale, strict=True)) / len(costs)
    return seconds, sum(cost.disk_mb * factor for cost, factor in zip(costs, scale, strict=True)) / len(costs)
