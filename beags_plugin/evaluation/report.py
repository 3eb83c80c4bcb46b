"""Results of an evaluation of a run, as plain values for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import FIGURES, IMAGE_FIGURES, KINDS, Kind, ObjectMetrics, SceneMetrics

Stage = Literal["before", "after"]
STAGES: tuple[Stage, ...] = ("before", "after")


@dataclass(frozen=True)
class RunMetrics:
    """The metrics of one run.

    scene: its name in tables. config: path of the run. classes: id to name, with or without the background. before:
    the state after assignment alone, None if the run has not saved it. notes: sentences for readers of the metrics.
    """

    scene: str
    config: str
    protocol: Protocol
    classes: Mapping[int, str]
    before: SceneMetrics | None
    after: SceneMetrics
    notes: tuple[str, ...] = ()

    def stages(self) -> dict[Stage, SceneMetrics]:
        """Return the states that exist, in order."""
        both = {"before": self.before, "after": self.after}
        return {stage: metrics for stage in STAGES if (metrics := both[stage]) is not None}

    def names(self) -> dict[int, str]:
        """Return object id to a unique name: a name used twice gets its id appended."""
        names = {class_id: self.classes.get(class_id, f"object {class_id}") for class_id in self.after.objects}
        given_names = list(names.values())
        return {c: f"{name} ({c})" if given_names.count(name) > 1 else name for c, name in names.items()}

    def worst(self) -> str | None:
        """Return the name of the object with the lowest extracted BIoU in the final state; None if none was scored."""
        names = self.names()
        scores = {c: each.extracted.biou for c, each in self.after.objects.items() if each.extracted is not None}
        known = {c: score for c, score in scores.items() if score is not None}
        return names[min(known, key=lambda c: known[c])] if known else None

    def to_json(self) -> dict[str, Any]:
        """Return the run as plain values for ``json.dump``; a missing or infinite metric is None.

        {"scene", "config", "protocol": {choice: value}, "extracted_truth", "colors_fitted", "notes": [sentence],
        "mean": {"extracted": {"before": {``FIGURES``}, "after": {...}}, "rendered": {...},
        "close_up": {...}}, "objects": {name: as mean}, "worst": name, "masks": [{"kind", "object", "view", "truth",
        "before": as in mean, "after": {...}}], "views": [{"view"}]}, and {"before", "after"} of every one of
        ``IMAGE_FIGURES`` in itself and in each view.
        """
        names, stages = self.names(), self.stages()
        view_names = [view.name for view in self.after.views]

        def images(pick: Callable[[SceneMetrics], Any]) -> dict[str, Any]:
            return {
                name: {
                    stage: finite(getattr(pick(stages[stage]), name)) if stage in stages else None for stage in STAGES
                }
                for name in IMAGE_FIGURES
            }

        def metrics(kind: Kind, pick: Callable[[SceneMetrics], Any]) -> dict[str, Any]:
            return {stage: plain_metrics(kind, pick(stages[stage]) if stage in stages else None) for stage in STAGES}

        def all_kinds(pick: Callable[[SceneMetrics], ObjectMetrics]) -> dict[str, Any]:
            return {kind: metrics(kind, lambda scene, kind=kind: getattr(pick(scene), kind)) for kind in KINDS}

        return {
            "scene": self.scene,
            "config": self.config,
            "protocol": asdict(self.protocol),
            "extracted_truth": self.after.extracted_truth,
            "colors_fitted": self.after.colors_fitted,
            "notes": list(self.notes),
            "mean": all_kinds(lambda scene: scene.mean),
            **images(lambda scene: scene),
            "objects": {name: all_kinds(lambda scene, c=c: scene.objects[c]) for c, name in names.items()},
            "worst": self.worst(),
            "masks": [
                {
                    "kind": mask.kind,
                    "object": names[mask.class_id],
                    "view": view_names[mask.view],
                    "truth": mask.truth,
                    **metrics(mask.kind, lambda scene, i=i: scene.masks[i].metrics),
                }
                for i, mask in enumerate(self.after.masks)
            ],
            "views": [{"view": name, **images(lambda scene, i=i: scene.views[i])} for i, name in enumerate(view_names)],
        }


def plain_metrics(kind: Kind, metrics: Any) -> dict[str, float | None]:
    """Return the metrics of a kind by name, such as {"acc", "iou", "biou", "spill"}, each a float or None."""
    return {name: None if metrics is None else finite(getattr(metrics, name)) for name in FIGURES[kind]}


def finite(value: float | None) -> float | None:
    """Return the value, or None if it is infinite, which JSON lacks."""
    return float(value) if value is not None and math.isfinite(value) else None
