"""Rows of an experiment's results, and their means over scenes, as plain values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from beags_benchmarks.experiments.experiment import Experiment, Variant
from beags_plugin.evaluation.metrics import mean
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import FIGURES as METRICS
from beags_plugin.evaluation.records import IMAGE_FIGURES
from beags_plugin.evaluation.report import STAGES as MOMENTS
from beags_plugin.evaluation.table import protocol_sentence

STAGES = ("base training", "reprojection", "assignment", "voxel grids", "objects", "refinement")
MEAN = "mean"  # value of the column "object" for all masks of the scene
_PLACE = ("scene", "seed", "variant", "sweep", "line", "x", "object", "failed")
_COSTS = ("cpu_seconds", "peak_memory_mb", "own_memory_mb", "steps", "gaussians")
_QUALITY = tuple(f"{metric}_{moment}" for metric in IMAGE_FIGURES for moment in MOMENTS) + tuple(
    f"{kind}_{metric}_{moment}" for kind, metrics in METRICS.items() for metric in metrics for moment in MOMENTS
)
_WORST, _LOST = "worst_biou_after", "lost_biou"
_OBJECTS = (_WORST, _LOST)  # extracted BIoU of the worst object, and the largest loss of an object by refinement
_MASKS = ("mask_error_given", "mask_error_used")
_SCALE = ("voxel_size", "training_pixels")
_OWN = ("labelled_share",)  # share of labelled training pixels with their class, from refiners that train codes
_TOTAL = "cpu_seconds total"  # base and refinement
_STAGES = tuple(f"seconds {stage}" for stage in STAGES)
FIGURES = (*_QUALITY, *_OBJECTS, *_STAGES, _TOTAL, *_COSTS, *_MASKS, *_SCALE, *_OWN)
COLUMNS = (*_PLACE, *FIGURES)


@dataclass(frozen=True)
class ResultRow:
    """A variant on a scene, or its mean over scenes.

    figures: values by the names of ``FIGURES``, or None; mask metrics in 0..1. objects: the same for each object.
    failed: the reason for missing figures, in a sentence. count: number of scenes and seeds in a mean. failures: number
    of failed ones. protocol: the evaluation's. truth, colors_fitted: see ``SceneMetrics.extracted_truth`` and
    ``colors_fitted``. protocol and truth are None in a mean and for a failed trial.
    """

    variant: Variant
    scene: str
    seed: int | None
    figures: Mapping[str, float | None]
    objects: Mapping[str, Mapping[str, float | None]]
    failed: str | None = None
    count: int = 1
    failures: int = 0
    protocol: Protocol | None = None
    truth: str | None = None
    colors_fitted: bool = False


def make_row(
    variant: Variant, scene: str, seed: int, base: Mapping[str, Any] | None, result: Mapping[str, Any] | None,
    failed: str | None,
) -> ResultRow:  # fmt: skip
    """Return the row of one trial; base, result: the worker's results for the base and the refinement, or None."""
    if base is None or result is None:
        return ResultRow(variant, scene, seed, dict.fromkeys(FIGURES), {}, failed or "it has no result")
    evaluation = result["evaluation"]
    figures: dict[str, float | None] = {**dict.fromkeys(FIGURES), **_masks(evaluation["mean"])}
    figures |= {f"{metric}_{m}": evaluation[metric][m] for metric in IMAGE_FIGURES for m in MOMENTS}
    seconds = {**result["seconds"], "base training": base["seconds"]["base training"]}
    figures |= {f"seconds {stage}": seconds.get(stage) for stage in STAGES}
    figures |= {name: result[name] for name in (*_COSTS, *_MASKS, *_SCALE)} | {name: result.get(name) for name in _OWN}
    parts = (base["cpu_seconds"], result["cpu_seconds"])  # None after an interruption
    figures[_TOTAL] = None if None in parts else sum(parts)
    objects = {name: _masks(metrics) for name, metrics in evaluation["objects"].items()}
    after, before = "extracted_biou_after", "extracted_biou_before"
    pairs = [(of[before], of[after]) for of in objects.values()]
    figures[_WORST] = min((end for _, end in pairs if end is not None), default=None)
    lost = (start - end for start, end in pairs if start is not None and end is not None)
    figures[_LOST] = max(lost, default=None)
    protocol = Protocol(**evaluation["protocol"])
    truth, fitted = evaluation["extracted_truth"], evaluation.get("colors_fitted", False)
    return ResultRow(variant, scene, seed, figures, objects, protocol=protocol, truth=truth, colors_fitted=fitted)


def _masks(evaluation: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the mask figures of ``RunMetrics.to_json``, {kind: {moment: {metric: value}}}, by names of ``FIGURES``."""
    return {
        f"{kind}_{metric}_{moment}": evaluation[kind][moment][metric]
        for kind, metrics in METRICS.items()
        for metric in metrics
        for moment in MOMENTS
    }


def means(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Return each variant's mean of every figure over its scenes and seeds, without failed trials.

    The figures of the worst object are the worst of all scenes. A figure is averaged over the scenes that have it. A
    variant whose trials all failed keeps the first reason.
    """
    of_variant: dict[str, list[ResultRow]] = {}
    for row in rows:
        of_variant.setdefault(row.variant.name, []).append(row)
    averaged = []
    for group in of_variant.values():
        good = [row for row in group if row.failed is None]
        figures = {name: mean(row.figures[name] for row in good) for name in FIGURES}
        for name, worst in ((_WORST, min), (_LOST, max)):
            figures[name] = worst((value for row in good if (value := row.figures[name]) is not None), default=None)
        failures = len(group) - len(good)
        reason = None if good else group[0].failed
        averaged.append(ResultRow(group[0].variant, MEAN, None, figures, {}, reason, len(good), failures))
    return averaged


def protocol_of(rows: Sequence[ResultRow]) -> str | None:
    """Return the sentences of ``beags eval`` with all choices behind the figures of rows; None if all failed.

    Trials of one bench have one protocol.
    """
    protocol = next((row.protocol for row in rows if row.protocol is not None), None)
    if protocol is None:
        return None
    return protocol_sentence(
        protocol,
        [row.truth for row in rows],
        shown=any(row.figures["shown_after"] is not None for row in rows),
        fitted=any(row.colors_fitted for row in rows),
    )


def error_left(row: ResultRow, reference: ResultRow | None) -> float | None:
    """Return (1 - extracted BIoU) of a row over that of the reference, or None if one is unknown."""
    metric = "extracted_biou_after"
    if reference is None or (value := row.figures[metric]) is None or (start := reference.figures[metric]) is None:
        return None
    return (1.0 - value) / (1.0 - start) if start < 1.0 else None


def find_reference(rows: Sequence[ResultRow], experiment: Experiment, scene: str) -> ResultRow | None:
    """Return the row of the experiment's reference variant on that scene."""
    return next((row for row in rows if row.variant.name == experiment.reference and row.scene == scene), None)


def flat(row: ResultRow) -> list[dict[str, Any]]:
    """Return the row as ``COLUMNS``, and a line for each object (quality only)."""
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


def report_json(experiment: Experiment, rows: Sequence[ResultRow], provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Return {"experiment", "description", "preset", "reference", provenance ..., "protocol", "rows", "means",
    "paper"}.

    protocol: see ``protocol_of``. Every row has ``COLUMNS``; "means" adds "count", "failures" and "error_left".
    """
    averaged = means(rows)
    reference = find_reference(averaged, experiment, MEAN)
    return {
        **experiment.header(),
        "reference": experiment.reference,
        **provenance,
        "protocol": protocol_of(rows),
        "rows": [line for row in rows for line in flat(row)],
        "means": [
            {**flat(row)[0], "count": row.count, "failures": row.failures, "error_left": error_left(row, reference)}
            for row in averaged
        ],
        "paper": experiment.paper and vars(experiment.paper),
    }


def table_rows(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """Return every row, objects included, then the means (scene "mean"), each with ``COLUMNS``."""
    return [line for row in [*rows, *means(rows)] for line in flat(row)]
