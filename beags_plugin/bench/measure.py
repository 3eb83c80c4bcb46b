"""What a refined run has to show: photo and mask metrics before and after refinement."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from beags_plugin.errors import UserError
from beags_plugin.evaluation.report import finite
from beags_plugin.evaluation.run_metrics import ObjectMetrics, SceneMetrics


def measure_run(config_path: Path) -> dict[str, Any]:
    """{"before": figures, "after": figures, "gaussians": n} of a run that refined (or only assigned).

    figures: {"psnr": dB, "ssim": 0..1, "extracted": {"acc", "iou", "biou"}, "rendered": {...},
    "objects": {name: {"extracted": {...}, "rendered": {...}}}}; mask figures in 0..1, None where unknown.
    before: what assignment alone gives, as the run has kept it. Raises ``UserError`` for a run that has not.
    """
    from beags_plugin.plugin.evaluate import EvaluatedRun

    run = EvaluatedRun(config_path)
    found = run.metrics()
    if found.before is None:
        raise UserError(f"{config_path.parent} has kept no base with classes: name a run that refined.")
    return {
        "before": _plain(found.before, found.classes),
        "after": _plain(found.after, found.classes),
        "gaussians": len(run.stages["after"].surfels()),
    }


def _plain(metrics: SceneMetrics, classes: Mapping[int, str]) -> dict[str, Any]:
    return {
        "psnr": finite(metrics.psnr),
        "ssim": finite(metrics.ssim),
        **_masks(metrics.mean),
        "objects": {classes[class_id]: _masks(found) for class_id, found in metrics.objects.items()},
    }


def _masks(metrics: ObjectMetrics) -> dict[str, Any]:
    kinds = {"extracted": metrics.extracted, "rendered": metrics.rendered}
    return {
        kind: None if found is None else {"acc": found.acc, "iou": found.iou, "biou": found.biou}
        for kind, found in kinds.items()
    }
