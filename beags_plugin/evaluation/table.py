"""Tables of an evaluation for a terminal, and the summary of ``beags demo``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from beags_plugin.evaluation.metrics import METRICS
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import KINDS, ObjectMetrics
from beags_plugin.evaluation.report import DataSetMetrics, RunMetrics, Stage

if TYPE_CHECKING:
    from rich.console import RenderableType

_STAGE_NAMES = {"before": "assigned", "after": "refined"}  # in summary.json
_TRUTHS = {
    "silhouette": "Extracted masks are compared with occlusion-free silhouettes{seen}.",
    "visible": "Extracted masks are compared with the visible masks; pixels that other objects cover are left out.",
    "both": "Extracted masks are compared with occlusion-free silhouettes{seen}, or else with the visible masks.",
}
_SEEN = " (less the parts that hardly any training photo shows, where the data says which)"


def summary_json(run: RunMetrics, seconds: Mapping[str, float], peak_memory_mb: float) -> dict[str, Any]:
    """Return the summary of one run as plain values for ``json.dump``; a missing or infinite figure is None.

    seconds: stage to wall time. peak_memory_mb: of the whole process, MB of 10^6 bytes. {"mean": {"extracted":
    {"assigned": {"acc", "iou", "biou"}, "refined": {...}}, "rendered": {...}}, "objects": {name: as mean}, "psnr":
    {"before", "after"}, "seconds": {stage: s}, "peak_memory_mb": n}.
    """
    content = run.to_json()

    def renamed(row: dict[str, Any]) -> dict[str, Any]:
        return {kind: {_STAGE_NAMES[stage]: figures for stage, figures in row[kind].items()} for kind in KINDS}

    return {
        "mean": renamed(content["mean"]),
        "objects": {name: renamed(row) for name, row in content["objects"].items()},
        "psnr": content["psnr"],
        "seconds": {stage: float(value) for stage, value in seconds.items()},
        "peak_memory_mb": float(peak_memory_mb),
    }


def render_run(
    run: RunMetrics, seconds: Mapping[str, float] | None = None, peak_memory_mb: float = 0
) -> RenderableType:
    """Return a table of one run: masks per object and stage in percent, then PSNR, SSIM, seconds, memory and notes."""
    from rich.console import Group
    from rich.text import Text

    content, stages = run.to_json(), list(run.stages())
    parts: list[RenderableType] = []
    if run.after.mean != ObjectMetrics(None, None):
        rows = {**content["objects"], "mean": content["mean"]}
        parts.append(_mask_table(f"{run.scene}: masks, %{_meaning(stages)}", "object", rows, stages))
    else:
        parts.append(Text(run.scene))
    lines = []
    if run.after.psnr is not None:
        for title, metric, digits in (("PSNR, dB", "psnr", 2), ("SSIM", "ssim", 3)):
            lines.append(f"{title}: " + " → ".join(_number(content[metric][stage], digits) for stage in stages))
    if seconds:
        lines.append("Seconds: " + ", ".join(f"{stage} {value:.1f}" for stage, value in seconds.items()))
    if peak_memory_mb:
        lines.append(f"Peak memory: {peak_memory_mb:.0f} MB")
    if run.after.extracted_truth in _TRUTHS:
        seen = _SEEN if run.protocol.silhouettes == "seen" else ""
        lines.append(_TRUTHS[run.after.extracted_truth].format(seen=seen))
    return Group(*parts, *(Text(line) for line in (*lines, *run.notes)))


def render_data_set(found: DataSetMetrics) -> RenderableType:
    """Return a table of several runs: the means of each scene, then those of the data set."""
    content = found.to_json()
    stages: list[Stage] = [stage for stage in ("before", "after") if any(stage in run.stages() for run in found.runs)]
    rows = {run.scene: scene for run, scene in zip(found.runs, content["scenes"], strict=True)}
    figures = {name: row["mean"] for name, row in rows.items()} | {found.name: content["mean"]}
    images = {name: row for name, row in rows.items()} | {found.name: content}
    return _mask_table(f"All scenes: masks, %{_meaning(stages)}", "scene", figures, stages, images)


def render_protocol(protocol: Protocol) -> RenderableType:
    """Return a line that names the choices that are not the defaults."""
    from rich.text import Text

    default = Protocol().to_json()
    changed = [f"{name} {value}" for name, value in protocol.to_json().items() if value != default[name]]
    return Text(f"Protocol: {', '.join(changed)}; else the defaults." if changed else "Protocol: the defaults.")


def _meaning(stages: Sequence[Stage]) -> str:
    return " (before: assignment alone; after: after refinement)" if len(stages) == 2 else ""


def _mask_table(
    title: str,
    first: str,
    rows: Mapping[str, Any],
    stages: Sequence[Stage],
    images: Mapping[str, Any] | None = None,
) -> RenderableType:
    """Return rows of both kinds of metrics per stage; ``images`` adds columns for PSNR and SSIM."""
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=SIMPLE, collapse_padding=True, pad_edge=False)
    table.add_column(first)
    table.add_column("stage")
    for kind in KINDS:
        for heading in (f"{kind}\nAcc", "\nIoU", "\nBIoU"):
            table.add_column(heading, justify="right", min_width=9 if kind in heading else 5)
    for heading in ("\nPSNR", "\nSSIM") if images else ():
        table.add_column(heading, justify="right")
    for name, row in rows.items():
        for stage in stages:
            cells = [_number(row[kind][stage][metric], 1, 100) for kind in KINDS for metric in METRICS]
            if images:
                cells += [_number(images[name]["psnr"][stage], 2), _number(images[name]["ssim"][stage], 3)]
            table.add_row(Text(name) if stage == stages[0] else "", stage, *cells)
        table.add_section()
    return table


def _number(value: float | None, digits: int, factor: float = 1.0) -> str:
    return "–" if value is None else f"{factor * value:.{digits}f}"
