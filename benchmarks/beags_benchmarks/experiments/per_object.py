"""Methods that train a separate scene for each object: their trials, and one merged result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from beags_benchmarks.experiments.scenes import TrialScene, quiet
from beags_plugin.evaluation.metrics import mean
from beags_plugin.evaluation.records import FIGURES, IMAGE_FIGURES
from beags_plugin.evaluation.report import STAGES

OBJECT = "object"  # the refiner's option that names the one object
_SUMS = ("cpu_seconds", "steps")
_LARGEST = ("peak_memory_mb", "own_memory_mb")


def object_names(scene: TrialScene) -> list[str]:
    """Return the names of a scene's objects, by ascending id; raises ``UserError`` for data that cannot be read."""
    if (sample := scene.unwritten) is not None:
        from beags_plugin.sample import FAMILIES

        return [
            name for class_id, name in FAMILIES.get(sample.family).scene(sample.seed).class_names.items() if class_id
        ]
    with quiet():
        outputs = scene.parser().setup().get_dataparser_outputs("train")
    return [name for class_id, name in sorted(outputs.metadata["classes"].items()) if class_id != 0]


def merged(results: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the worker's results for single objects, by name, as one result.

    Masks of an object come from its own scene. Metrics of images are means over the scenes, seconds and
    steps are sums, memory is the largest value.
    """
    first = next(iter(results.values()))
    own = {name: result["evaluation"]["objects"][name] for name, result in results.items()}
    masks = [
        mask for name, result in results.items() for mask in result["evaluation"]["masks"] if mask["object"] == name
    ]
    evaluation: dict[str, Any] = {**first["evaluation"], "objects": own, "masks": masks}
    evaluation["mean"] = {
        kind: {
            stage: {metric: mean(m[stage][metric] for m in masks if m["kind"] == kind) for metric in metrics}
            for stage in STAGES
        }
        for kind, metrics in FIGURES.items()
    }
    for figure in IMAGE_FIGURES:
        evaluation[figure] = {
            stage: mean(result["evaluation"][figure][stage] for result in results.values()) for stage in STAGES
        }
    stages = {stage for result in results.values() for stage in result["seconds"]}
    seconds = {stage: math.fsum(result["seconds"].get(stage, 0.0) for result in results.values()) for stage in stages}
    return {
        **first,
        "evaluation": evaluation,
        "seconds": seconds,
        "gaussians": mean(result["gaussians"] for result in results.values()),
        **{name: _sum([result[name] for result in results.values()]) for name in _SUMS},
        **{name: max(result[name] for result in results.values()) for name in _LARGEST},
    }


def _sum(values: Sequence[float | None]) -> float | None:
    return None if None in values else sum(value for value in values if value is not None)
