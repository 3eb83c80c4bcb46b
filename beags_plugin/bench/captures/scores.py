"""Scores of captures: objects drawn alone are compared with traced silhouettes, where there are any."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from beags_plugin.evaluation.records import FIGURES
from beags_plugin.evaluation.report import STAGES

EXTRACTED, SILHOUETTE = "extracted", "silhouette"


def by_silhouettes_alone(result: Mapping[str, Any]) -> dict[str, Any]:
    """Return a result of the worker with the extracted figures of traced silhouettes alone.

    Other held-out views have masks that a program drew, at best; those still serve the rendered figures.
    """
    evaluation = result["evaluation"]
    masks = [mask for mask in evaluation["masks"] if mask["kind"] != EXTRACTED or mask["truth"] == SILHOUETTE]
    traced = [mask for mask in masks if mask["kind"] == EXTRACTED]
    objects = {
        name: {**figures, EXTRACTED: _means([mask for mask in traced if mask["object"] == name])}
        for name, figures in evaluation["objects"].items()
    }
    changed = {
        "masks": masks,
        "mean": {**evaluation["mean"], EXTRACTED: _means(traced)},
        "objects": objects,
        "extracted_truth": SILHOUETTE if traced else None,
    }
    return {**result, "evaluation": {**evaluation, **changed}}


def _means(masks: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, float | None]]:
    return {
        stage: {metric: _mean([mask[stage][metric] for mask in masks]) for metric in FIGURES[EXTRACTED]}
        for stage in STAGES
    }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None
