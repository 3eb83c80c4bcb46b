"""From the outcomes of an experiment's trials to rows and means over scenes, as plain values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from beags_plugin.bench.experiment import Experiment, Variant
from beags_plugin.evaluation.metrics import METRICS
from beags_plugin.evaluation.records import KINDS
from beags_plugin.evaluation.report import STAGES as MOMENTS

STAGES = ("base training", "reprojection", "assignment", "voxel grids", "refinement")
MEAN = "mean"  # in the column "object": over all masks of the scene
_PLACE = ("scene", "seed", "variant", "sweep", "line", "x", "object", "failed")
_COSTS = ("cpu_seconds", "peak_memory_mb", "own_memory_mb", "steps", "gaussians")
_QUALITY = tuple(f"{metric}_{moment}" for metric in ("psnr", "ssim") for moment in MOMENTS) + tuple(
    f"{kind}_{metric}_{moment}" for kind in KINDS for metric in METRICS for moment in MOMENTS
)
_MASKS = ("mask_error_given", "mask_error_used")
_SCALE = ("voxel_size", "training_pixels")
_TOTAL = "cpu_seconds total"  # of the base and the refinement
FIGURES = (*_QUALITY, *(f"seconds {stage}" for stage in STAGES), _TOTAL, *_COSTS, *_MASKS, *_SCALE)
COLUMNS = (*_PLACE, *FIGURES)


@dataclass(frozen=True)
class Row:
    """A variant on a scene, or its mean over scenes.

    figures: name (of ``FIGURES``) to value, None where it does not exist; mask metrics in 0..1. objects: the same of
    each object. failed: why there are no figures, in a sentence. count: scenes and seeds that a mean is over;
    failures: those that it lacks.
    """

    variant: Variant
    scene: str
    seed: int | None
    figures: Mapping[str, float | None]
    objects: Mapping[str, Mapping[str, float | None]]
    failed: str | None = None
    count: int = 1
    failures: int = 0


def make_row(
    variant: Variant, scene: str, seed: int, base: Mapping[str, Any] | None, result: Mapping[str, Any] | None,
    failed: str | None,
) -> Row:  # fmt: skip
    """The row of one trial. base, result: what the worker wrote for the base and for the refinement, if it did."""
    if base is None or result is None:
        return Row(variant, scene, seed, dict.fromkeys(FIGURES), {}, failed or "it has no result")
    figures: dict[str, float | None] = dict.fromkeys(FIGURES)
    evaluation = result["evaluation"]
    figures |= _masks(evaluation["mean"])
    figures |= {f"{metric}_{m}": evaluation[metric][m] for metric in ("psnr", "ssim") for m in MOMENTS}
    seconds = {**result["seconds"], "base training": base["seconds"]["base training"]}
    figures |= {f"seconds {stage}": seconds.get(stage) for stage in STAGES}
    figures |= {name: result[name] for name in (*_COSTS, *_MASKS, *_SCALE)}
    figures[_TOTAL] = base["cpu_seconds"] + result["cpu_seconds"]
    objects = {name: _masks(found) for name, found in evaluation["objects"].items()}
    return Row(variant, scene, seed, figures, objects)


def _masks(found: Mapping[str, Any]) -> dict[str, float | None]:
    """Mask figures of ``RunMetrics.to_json``, {kind: {moment: {metric: value}}}, by their names here."""
    return {
        f"{kind}_{metric}_{moment}": found[kind][moment][metric]
        for kind in KINDS
        for metric in METRICS
        for moment in MOMENTS
    }


def means(rows: Sequence[Row]) -> list[Row]:
    """Per variant, in order, the mean of every figure over its scenes and seeds; trials that failed are left out.

    A figure that some scene lacks is averaged over those that have it. A variant whose trials all failed keeps the
    first reason.
    """
    of_variant: dict[str, list[Row]] = {}
    for row in rows:
        of_variant.setdefault(row.variant.name, []).append(row)
    averaged = []
    for group in of_variant.values():
        good = [row for row in group if row.failed is None]
        figures = {name: _mean(row.figures[name] for row in good) for name in FIGURES}
        failures = len(group) - len(good)
        reason = None if good else group[0].failed
        averaged.append(Row(group[0].variant, MEAN, None, figures, {}, reason, len(good), failures))
    return averaged


def _mean(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def error_left(row: Row, reference: Row | None, metric: str = "extracted_biou_after") -> float | None:
    """(1 - metric) of a row over (1 - metric) of the reference: what is left of its error; None if unknown."""
    if reference is None or (value := row.figures[metric]) is None or (start := reference.figures[metric]) is None:
        return None
    return (1.0 - value) / (1.0 - start) if start < 1.0 else None


def find_reference(rows: Sequence[Row], experiment: Experiment, scene: str) -> Row | None:
    """The row of the experiment's reference variant on that scene."""
    return next((row for row in rows if row.variant.name == experiment.reference and row.scene == scene), None)


def flat(row: Row) -> list[dict[str, Any]]:
    """The row as ``COLUMNS``, and a line for each object (quality only)."""
    variant = row.variant
    place = {
        "scene": row.scene,
        "seed": row.seed,
        "variant": variant.name,
        "sweep": variant.sweep or None,
        "line": variant.line or None,
        "x": variant.x,
        "object": MEAN,
        "failed": row.failed,
    }
    empty = dict.fromkeys(COLUMNS)
    lines = [{**empty, **place, **row.figures}]
    return lines + [{**empty, **place, "object": name, **figures} for name, figures in row.objects.items()]


def report_json(experiment: Experiment, rows: Sequence[Row], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """{"experiment", "description", "preset", "reference", provenance ..., "rows": [...], "means": [...], "paper"}.

    Every row has ``COLUMNS``; rows of ``means`` have "count", "failures" and "error_left" besides.
    """
    averaged = means(rows)
    reference = find_reference(averaged, experiment, MEAN)
    paper = experiment.paper
    return {
        "experiment": experiment.name,
        "description": experiment.description,
        "preset": experiment.preset,
        "reference": experiment.reference,
        **provenance,
        "rows": [line for row in rows for line in flat(row)],
        "means": [
            {**flat(row)[0], "count": row.count, "failures": row.failures, "error_left": error_left(row, reference)}
            for row in averaged
        ],
        "paper": paper and {"source": paper.source, "columns": list(paper.columns), "rows": dict(paper.rows)},
    }


def table_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Every row, objects included, then the means (scene "mean"), each with ``COLUMNS``."""
    return [line for row in [*rows, *means(rows)] for line in flat(row)]
