"""Tables of an evaluation for a terminal, and the summary of ``beags demo``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import FIGURES, KINDS, MASK_KINDS, ObjectMetrics
from beags_plugin.evaluation.report import RunMetrics, Stage
from beags_plugin.evaluation.shown import TAU

if TYPE_CHECKING:
    from rich.console import RenderableType

_HEADINGS = {"acc": "Acc", "iou": "IoU", "biou": "BIoU", "psnr": "PSNR", "ssim": "SSIM", "spill": "spill"}
_STAGE_NAMES = {"before": "assigned", "after": "refined"}  # names in summary.json
_Row = tuple[str, Mapping[str, Any]]
"""A row's name and its metrics {kind: {stage: {metric: value}}}."""
_TRUTHS = {
    "silhouette": "whole occlusion-free silhouettes",
    "visible": "visible masks, less the pixels where another object stands nearer",
    "both": "whole occlusion-free silhouettes, else visible masks, less the pixels where another object stands nearer",
}


def summary_json(run: RunMetrics, seconds: Mapping[str, float], peak_memory_mb: float) -> dict[str, Any]:
    """Return the summary of one run as plain values for ``json.dump``; a missing or infinite metric is None.

    seconds: stage to wall time. peak_memory_mb: peak of the whole process, MB of 10^6 bytes. {"mean": {"extracted":
    {"assigned": {"acc", "iou", "biou", "spill"}, "refined": {...}}, ...}, "objects": {name: as mean}, "psnr":
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
    """Return tables of one run per object and stage, then PSNR, SSIM, seconds, memory and notes."""
    from rich.console import Group
    from rich.text import Text

    content, stages = run.to_json(), list(run.stages())
    parts: list[RenderableType] = []
    if run.after.mean != ObjectMetrics(None, None):
        rows = [*content["objects"].items(), ("mean", content["mean"])]
        parts.append(_mask_table(run.scene, [*rows, *_worst(content)], stages))
        parts += _close_up_table(run.scene, rows, stages)
    else:
        parts.append(Text(run.scene))
    lines = []
    share = _cell("shown", run.after.shown)
    of_images = {
        "psnr": "PSNR, dB", "psnr_fit": "PSNR after colour fit, dB", "psnr_shown": f"PSNR of the {share} % shown, dB",
        "psnr_objects": "PSNR inside the objects, dB", "ssim": "SSIM",
    }  # fmt: skip
    for metric, title in of_images.items():
        if getattr(run.after, metric) is not None:
            lines.append(f"{title}: " + " → ".join(_cell(metric, content[metric][stage]) for stage in stages))
    if seconds:
        lines.append("Seconds: " + ", ".join(f"{stage} {value:.1f}" for stage, value in seconds.items()))
    if peak_memory_mb:
        lines.append(f"Peak memory: {peak_memory_mb:.0f} MB")
    return Group(*parts, *(Text(line) for line in (*lines, *run.notes, protocol_line(run)) if line))


def protocol_line(run: RunMetrics) -> str:
    """Return sentences with all choices behind the scores of a run; "" if none needs one."""
    after = run.after
    return protocol_sentence(
        run.protocol, [after.extracted_truth], shown=after.shown is not None, fitted=after.colors_fitted
    )


def protocol_sentence(protocol: Protocol, truths: Iterable[str | None], *, shown: bool, fitted: bool) -> str:
    """Return sentences with all choices behind scores; "" if none needs one.

    truths: ``SceneMetrics.extracted_truth`` of each scene; without any, no mask is scored. shown: whether there are
    such metrics. fitted: whether a run has learned exposures.
    """
    known = {truth for truth in truths if truth is not None}
    sentences = []
    if known:
        truth = _TRUTHS[next(iter(known)) if len(known) == 1 else "both"]
        sentences.append(
            f"Protocol: extracted masks against {truth}; above {protocol.threshold:g}; boundary band and margin of "
            f"spill {100 * protocol.band_share:g} % of the diagonal; the prediction is resized; masks empty in truth "
            "and prediction are left out, IoU and BIoU of those empty in truth alone are 0; means over masks."
        )
    if shown:
        sentences.append(
            "PSNR shown: over the pixels whose surface (median depth before refinement, else of the run) some "
            f"training view shows within {100 * TAU:g} % of its depth."
        )
    if fitted and sentences:
        what = "PSNR shown and PSNR objects are" if known else "PSNR shown is"
        sentences.append(
            f"Of runs that have learned the photos' exposures, {what} taken after the colour fit of the whole view."
        )
    return " ".join(sentences)


def _worst(run: Mapping[str, Any]) -> list[_Row]:
    """Return the row of the object with the lowest extracted BIoU; no row for a single object."""
    name = run["worst"]
    return [] if name is None or len(run["objects"]) < 2 else [(f"worst: {name}", run["objects"][name])]


def _mask_table(caption: str, rows: Sequence[_Row], stages: Sequence[Stage]) -> RenderableType:
    """Return a table of all kinds of mask metrics per stage."""
    # The metric covered is in files only: one more column is too many for a terminal.
    columns = [(kind, metric) for kind in MASK_KINDS for metric in FIGURES[kind] if metric != "covered"]
    meaning = " (before: assignment alone; after: after refinement)" if len(stages) == 2 else ""
    return _table(f"{caption}: masks, %{meaning}", rows, stages, columns)


def _close_up_table(caption: str, rows: Sequence[_Row], stages: Sequence[Stage]) -> Iterator[RenderableType]:
    """Yield a table of close-ups if any row has such metrics."""
    columns = [("close_up", metric) for metric in FIGURES["close_up"]]
    if any(row[kind][stage][metric] is not None for _, row in rows for stage in stages for kind, metric in columns):
        yield _table(f"{caption}: objects at the photos' own size, PSNR in dB, masks in %", rows, stages, columns)


def _table(
    title: str, rows: Sequence[_Row], stages: Sequence[Stage], columns: Sequence[tuple[str, str]]
) -> RenderableType:
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=SIMPLE, collapse_padding=True, pad_edge=False)
    table.add_column("object")
    table.add_column("stage")
    for index, (kind, metric) in enumerate(columns):
        new = index == 0 or columns[index - 1][0] != kind
        heading = _HEADINGS[metric]
        table.add_column(f"{kind if new else ''}\n{heading}", justify="right", min_width=len(kind) if new else 5)
    for name, row in rows:
        for stage in stages:
            cells = [_cell(metric, row[kind][stage][metric]) for kind, metric in columns]
            table.add_row(Text(name) if stage == stages[0] else "", stage, *cells)
        table.add_section()
    return table


def _cell(metric: str, value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.2f}" if "psnr" in metric else f"{value:.3f}" if metric == "ssim" else f"{100 * value:.1f}"
