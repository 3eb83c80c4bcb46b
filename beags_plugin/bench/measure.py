"""What a refined run has to show: photo and mask metrics before and after refinement."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.labels.class_ids import IGNORE

if TYPE_CHECKING:
    from beags_plugin.plugin.runs.prepared import TrainingMasks


def measure_run(config_path: Path) -> dict[str, Any]:
    """{"evaluation", "mask_error_given", "mask_error_used"} of a refined run.

    evaluation: ``RunMetrics.to_json`` without its single masks and views; its "before" is the base with the classes of
    this very run, which is what assignment alone gives. mask_error_...: see ``mask_errors``.
    """
    from beags_plugin.plugin.objects.evaluate import evaluate_run
    from beags_plugin.plugin.runs.prepared import training_masks
    from beags_plugin.plugin.runs.run_config import load_run_config

    found = evaluate_run(config_path).to_json()
    evaluation = {name: value for name, value in found.items() if name not in ("masks", "views")}
    return {"evaluation": evaluation, **mask_errors(training_masks(load_run_config(config_path)))}


def mask_errors(views: Sequence[TrainingMasks]) -> dict[str, float | None]:
    """{"mask_error_given", "mask_error_used"}: shares in 0..1 of wrong pixels in the training masks, as the data has
    them and after reprojection; over the pixels that are labelled in both the mask and the truth; None without truth.
    """

    def error(kind: str) -> float | None:
        wrong = counted = 0
        for view in views:
            mask = getattr(view, kind)
            if mask is not None and view.exact is not None:
                known = (mask != IGNORE) & (view.exact != IGNORE)
                wrong += int(((mask != view.exact) & known).sum())
                counted += int(known.sum())
        return wrong / counted if counted else None

    return {f"mask_error_{kind}": error(kind) for kind in ("given", "used")}
