"""Metrics of a refined run: of photos and masks, before and after refinement."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.labels.class_ids import IGNORE

if TYPE_CHECKING:
    from beags_plugin.runs.prepared import TrainingMasks


def measure_run(config_path: Path) -> dict[str, Any]:
    """Return {"evaluation", "mask_error_given", "mask_error_used"} of a refined run.

    evaluation: ``RunMetrics.to_json`` without single views. Its "before" is the base with the classes of this run, the
    result of assignment alone. mask_error_...: see ``mask_error``.
    """
    from beags_plugin.objects.evaluate import evaluate_run
    from beags_plugin.runs.prepared import training_masks
    from beags_plugin.runs.relocation import open_run

    evaluation = evaluate_run(config_path).to_json()
    del evaluation["views"]
    views = training_masks(open_run(config_path))
    return {"evaluation": evaluation, **{f"mask_error_{kind}": mask_error(views, kind) for kind in ("given", "used")}}


def mask_error(views: Sequence[TrainingMasks], kind: str) -> float | None:
    """Return the share of wrong pixels in the training masks, 0..1, or None without exact masks.

    kind: "given", the masks of the data, or "used", those after reprojection. A pixel counts if mask and exact mask
    both label it.
    """
    wrong = counted = 0
    for view in views:
        mask = getattr(view, kind)
        if mask is not None and view.exact is not None:
            known = (mask != IGNORE) & (view.exact != IGNORE)
            wrong += int(((mask != view.exact) & known).sum())
            counted += int(known.sum())
    return wrong / counted if counted else None
