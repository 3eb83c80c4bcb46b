"""The figures of a run as a table and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from beags_plugin.evaluation.metrics import MaskMetrics
from beags_plugin.evaluation.run_metrics import ObjectMetrics, SceneMetrics

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

_KINDS = ("extracted", "rendered")
_STAGES = ("assigned", "refined")
_METRICS = ("acc", "iou", "biou")
_TRUTHS = {
    "silhouette": "Extracted masks are compared with occlusion-free silhouettes; parts of them that hardly any "
    "training photo shows (where the data says which) are left out.",
    "visible": "Extracted masks are compared with the visible masks; pixels that other objects cover are left out.",
    "both": "Extracted masks are compared with occlusion-free silhouettes, or else with the visible masks.",
}


@dataclass(frozen=True)
class RunReport:
    """What a run has to show.

    classes: id to name, with or without the background. assigned: after assignment alone, before refining.
    refined: after refinement, or None if there was none. seconds: stage to wall time. peak_memory_mb: of the
    whole process, MB of 10^6 bytes.
    """

    classes: Mapping[int, str]
    assigned: SceneMetrics
    refined: SceneMetrics | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    peak_memory_mb: float = 0.0


def summary_json(report: RunReport) -> dict[str, Any]:
    """The report as plain values, ready for ``json.dump``; a figure that does not exist or is infinite is None.

    {"mean": {"extracted": {"assigned": {"acc", "iou", "biou"}, "refined": {...}}, "rendered": {...}},
    "objects": {name: as mean}, "psnr": {"before", "after"}, "seconds": {stage: s}, "peak_memory_mb": n}.
    """
    stages = {"assigned": report.assigned, "refined": report.refined}

    def both(pick) -> dict[str, Any]:
        return {
            kind: {stage: _plain(None if scene is None else pick(scene), kind) for stage, scene in stages.items()}
            for kind in _KINDS
        }

    return {
        "mean": both(lambda scene: scene.mean),
        "objects": {
            name: both(lambda scene, class_id=class_id: scene.objects.get(class_id))
            for class_id, name in unique_names(report).items()
        },
        "psnr": {
            "before": _finite(report.assigned.psnr),
            "after": _finite(None if report.refined is None else report.refined.psnr),
        },
        "seconds": {stage: float(seconds) for stage, seconds in report.seconds.items()},
        "peak_memory_mb": float(report.peak_memory_mb),
    }


def unique_names(report: RunReport) -> dict[int, str]:
    """Object id to a name that no other object has: a name used twice gets its id appended."""
    names = {class_id: report.classes.get(class_id, f"object {class_id}") for class_id in report.assigned.objects}
    taken = list(names.values())
    return {c: f"{name} ({c})" if taken.count(name) > 1 else name for c, name in names.items()}


def _plain(metrics: ObjectMetrics | None, kind: str) -> dict[str, float | None]:
    value: MaskMetrics | None = None if metrics is None else getattr(metrics, kind)
    return {name: None if value is None else float(getattr(value, name)) for name in _METRICS}


def _finite(value: float | None) -> float | None:
    """JSON has no infinity: the PSNR of equal images becomes None."""
    return float(value) if value is not None and math.isfinite(value) else None


def render_table(report: RunReport) -> RenderableType:
    """The report for a terminal: masks per object and stage in percent, then PSNR, seconds and memory."""
    from rich.box import SIMPLE
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    summary = summary_json(report)
    stages = _STAGES if report.refined is not None else _STAGES[:1]
    table = Table(
        title="Masks, % (assigned: assignment alone; refined: after refinement)", title_justify="left", box=SIMPLE
    )
    table.add_column("object")
    table.add_column("stage")
    for kind in _KINDS:
        for title in (f"{kind}\nAcc", "\nIoU", "\nBIoU"):
            table.add_column(title, justify="right")
    for name, row in [*summary["objects"].items(), ("mean", summary["mean"])]:
        for stage in stages:
            title = Text(name) if stage == stages[0] else ""
            figures = (row[kind][stage][metric] for kind in _KINDS for metric in _METRICS)
            table.add_row(title, stage, *(_number(figure, 1, 100) for figure in figures))
        table.add_section()

    psnr = summary["psnr"]
    lines = [f"PSNR, dB: {_number(psnr['before'], 2)} → {_number(psnr['after'], 2)}"]
    if summary["seconds"]:
        lines.append("Seconds: " + ", ".join(f"{stage} {s:.1f}" for stage, s in summary["seconds"].items()))
    if report.peak_memory_mb:
        lines.append(f"Peak memory: {report.peak_memory_mb:.0f} MB")
    if report.assigned.extracted_truth in _TRUTHS:
        lines.append(_TRUTHS[report.assigned.extracted_truth])
    return Group(table, *(Text(line) for line in lines))


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"


def print_table(report: RunReport, console: Console | None = None) -> None:
    """Print ``render_table`` to the console, by default the terminal."""
    from rich.console import Console

    (console or Console()).print(render_table(report))
