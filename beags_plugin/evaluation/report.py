"""Results of an evaluation, of one run and of several: plain values for JSON, rows for CSV."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

from beags_plugin.evaluation.metrics import mean, mean_metrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import FIGURES, IMAGE_FIGURES, KINDS, Kind, ObjectMetrics, SceneMetrics
from beags_plugin.evaluation.run_metrics import pooled_average

Stage = Literal["before", "after"]
STAGES: tuple[Stage, ...] = ("before", "after")
CSV_COLUMNS = (
    *("scene", "object", "stage"),
    *(f"{kind}_{name}" for kind, names in FIGURES.items() for name in names),
    *IMAGE_FIGURES,
)


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
        "mean": {"extracted": {"before": {``FIGURES``}, "after": {...}}, "seen": {...}, "rendered": {...}, "removal":
        {...}, "close_up": {...}}, "objects": {name: as mean}, "worst": name, "masks":
        [{"kind", "object", "view", "truth", "before": as in mean, "after": {...}}], "views": [{"view"}]}, and
        {"before", "after"} of every one of ``IMAGE_FIGURES`` in itself and in each view.
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


@dataclass(frozen=True)
class DataSetMetrics:
    """Runs of one protocol and their mean.

    name: of the data set, in tables. means: stage to the mean of all kinds. images: each of ``IMAGE_FIGURES`` to its
    mean by stage. "before" is left out unless all scenes with "after" have it.
    """

    name: str
    runs: tuple[RunMetrics, ...]
    means: Mapping[Stage, ObjectMetrics] = field(default_factory=dict)
    images: Mapping[str, Mapping[Stage, float | None]] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Return {"data_set", "protocol", "mean", ``IMAGE_FIGURES`` (these as of a run), "scenes": [run, ...]}."""
        empty = ObjectMetrics(None, None)
        return {
            "data_set": self.name,
            "protocol": asdict(self.runs[0].protocol),
            "mean": {
                kind: {stage: plain_metrics(kind, getattr(self.means.get(stage, empty), kind)) for stage in STAGES}
                for kind in KINDS
            },
            **{name: {stage: finite(found[stage]) for stage in STAGES} for name, found in self.images.items()},
            "scenes": [run.to_json() for run in self.runs],
        }

    def csv_rows(self) -> list[list[Any]]:
        """Return a row per scene, object and stage, then the means; columns as ``CSV_COLUMNS``, fractions in 0..1."""
        rows, no_images = [], [None] * len(IMAGE_FIGURES)
        for run in self.runs:
            for stage, scene in run.stages().items():
                for class_id, name in run.names().items():
                    rows.append([run.scene, name, stage, *_cells(scene.objects[class_id]), *no_images])
                images = [finite(getattr(scene, name)) for name in IMAGE_FIGURES]
                rows.append([run.scene, "", stage, *_cells(scene.mean), *images])
        for stage, metrics in self.means.items():
            images = [finite(of_stage[stage]) for of_stage in self.images.values()]
            rows.append([self.name, "", stage, *_cells(metrics), *images])
        return rows


def data_set(name: str, runs: Sequence[RunMetrics]) -> DataSetMetrics:
    """Return the runs and their mean, as ``protocol.data_set_average`` says; raises ``ValueError`` without runs."""
    if not runs or len({run.protocol for run in runs}) != 1:
        raise ValueError("a data set needs runs, all scored by one protocol")
    protocol = runs[0].protocol
    kinds: dict[Stage, dict[Kind, Any]] = {stage: {} for stage in STAGES}
    for kind in KINDS:
        for stage, scenes in _comparable(runs, lambda scene, kind=kind: getattr(scene.mean, kind)).items():
            if protocol.data_set_average == "pooled":
                groups: dict[Hashable, Any] = {index: scene.masks for index, scene in enumerate(scenes)}
                kinds[stage][kind] = pooled_average(groups, kind, protocol)
            else:
                kinds[stage][kind] = mean_metrics(getattr(scene.mean, kind) for scene in scenes)

    def of_images(metric: str) -> dict[Stage, float | None]:
        by_stage: dict[Stage, float | None] = dict.fromkeys(STAGES)
        for stage, scenes in _comparable(runs, lambda scene: getattr(scene, metric)).items():
            pooled = protocol.data_set_average == "pooled"
            units = [view for scene in scenes for view in scene.views] if pooled else scenes
            by_stage[stage] = mean(getattr(unit, metric) for unit in units)
        return by_stage

    images = {name: of_images(name) for name in IMAGE_FIGURES}
    means: dict[Stage, ObjectMetrics] = {}
    for stage in STAGES:
        figures = ObjectMetrics(**{kind: kinds[stage].get(kind) for kind in KINDS})
        if figures != ObjectMetrics(None, None) or images["psnr"][stage] is not None:
            means[stage] = figures
    return DataSetMetrics(name, tuple(runs), means, images)


def _comparable(runs: Sequence[RunMetrics], has: Callable[[SceneMetrics], Any]) -> dict[Stage, list[SceneMetrics]]:
    """Return stage to the scenes with a metric; no "before" unless all of them have it."""
    comparable = [run for run in runs if has(run.after) is not None]
    scenes: dict[Stage, list[SceneMetrics]] = {"after": [run.after for run in comparable]}
    before = [run.before for run in comparable if run.before is not None and has(run.before) is not None]
    if len(before) == len(comparable):
        scenes = {"before": before, **scenes}
    return scenes


def plain_metrics(kind: Kind, metrics: Any) -> dict[str, float | None]:
    """Return the metrics of a kind by name, such as {"acc", "iou", "biou", "spill"}, each a float or None."""
    return {name: None if metrics is None else finite(getattr(metrics, name)) for name in FIGURES[kind]}


def _cells(metrics: ObjectMetrics) -> list[float | None]:
    return [value for kind in KINDS for value in plain_metrics(kind, getattr(metrics, kind)).values()]


def finite(value: float | None) -> float | None:
    """Return the value, or None if it is infinite, which JSON lacks."""
    return float(value) if value is not None and math.isfinite(value) else None
