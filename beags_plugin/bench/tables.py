"""An experiment's rows as tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from beags_plugin.bench.experiment import Experiment, Paper
from beags_plugin.bench.report import number
from beags_plugin.bench.results import STAGES, Row, error_left, find_reference, means

if TYPE_CHECKING:
    from rich.table import Table

_HEAD = (
    "extracted\nIoU",
    "\nBIoU",
    "rendered\nIoU",
    "\nBIoU",
    "PSNR, dB\nbefore",
    "\nafter",
    "SSIM\nafter",
    "prepare\ns",
    "refine\ns",
    "CPU\ns",
    "memory, MB\npeak",
    "\nown",
)


def tables(experiment: Experiment, rows: Sequence[Row]) -> list[Table | str]:
    """What to print: the means, each scene, the paper's figures, and what failed."""
    averaged = means(rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    title = f"{experiment.name}, {experiment.preset}: mean over {', '.join(scenes)}"
    printed: list[Table | str] = [_table(experiment, averaged, title)]
    if len(scenes) > 1:
        for scene in scenes:
            of_scene = [row for row in rows if row.scene == scene]
            printed.append(_table(experiment, of_scene, scene))
    if experiment.paper is not None:
        printed.append(paper_table(experiment.paper, experiment.reference))
    printed.append("Seconds of stages are wall time; CPU: of the whole trial after its base, all threads.")
    printed.append("Memory: the peak of the trial's process, and what of it the loaded program does not take.")
    if experiment.reference is not None:
        printed.append(f"BIoU error left: (100 - extracted BIoU) as a share of that of {experiment.reference!r}.")
    printed += [line for sweep in experiment.sweeps if (line := memory_line(averaged, sweep)) is not None]
    printed += [f"failed: {row.variant.name} on {row.scene}: {row.failed}" for row in rows if row.failed]
    return printed


def _table(experiment: Experiment, rows: Sequence[Row], title: str) -> Table:
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", box=SIMPLE)
    table.add_column("variant", no_wrap=True)
    relative = any(row.variant.sweep in experiment.relative_to_pixels for row in rows)
    if relative:
        table.add_column("per 10^6\npixels", justify="right")
    compared = experiment.reference is not None
    masks = experiment.confidence and any(row.figures["mask_error_given"] is not None for row in rows)
    if masks:
        table.add_column("wrong, %\ngiven", justify="right")
        table.add_column("mask pixels\nused", justify="right")
    if compared:
        table.add_column("BIoU error\nleft, %", justify="right")
    for head in _HEAD:
        table.add_column(head, justify="right")
    reference = find_reference(rows, experiment, rows[0].scene) if rows else None
    former = None
    for row in rows:
        if former is not None and (row.variant.sweep, row.variant.line) != former:
            table.add_section()
        former = (row.variant.sweep, row.variant.line)
        name = row.variant.name + (f" ({row.count} of {row.count + row.failures} scenes)" if row.failures else "")
        cells = [per_million_pixels(row, experiment)] if relative else []
        if masks:
            cells += [number(_percent(row.figures[f"mask_error_{kind}"]), 2) for kind in ("given", "used")]
        if compared:
            cells.append(percent(error_left(row, reference)))
        table.add_row(Text(name), *cells, *(["failed"] if row.failed else _cells(row)))
    return table


def per_million_pixels(row: Row, experiment: Experiment) -> str:
    """The place on a sweep's axis relative to the pixels of all training views, where that is asked for."""
    pixels = row.figures["training_pixels"]
    if row.variant.sweep not in experiment.relative_to_pixels or not pixels or row.variant.x is None:
        return "–"
    return f"{1e6 * row.variant.x / pixels:.3g}"


def _cells(row: Row) -> list[str]:
    figures = row.figures
    prepare = [figures[f"seconds {stage}"] for stage in STAGES[1:-1]]
    return [
        percent(figures["extracted_iou_after"]),
        percent(figures["extracted_biou_after"]),
        percent(figures["rendered_iou_after"]),
        percent(figures["rendered_biou_after"]),
        number(figures["psnr_before"], 2),
        number(figures["psnr_after"], 2),
        number(figures["ssim_after"], 3),
        number(sum(value for value in prepare if value is not None), 1),
        number(figures["seconds refinement"], 1),
        number(figures["cpu_seconds"], 1),
        number(figures["peak_memory_mb"], 0),
        number(figures["own_memory_mb"], 0),
    ]


def paper_table(paper: Paper, reference: str | None) -> Table:
    """The paper's own figures, said to be such."""
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    title = f"For comparison, the paper's figures, not ours: {paper.source}; IoU / BIoU, % (BIoU error left, %)"
    table = Table(title=Text(title), title_justify="left", box=SIMPLE)
    table.add_column("variant")
    for column in paper.columns:
        table.add_column(column, justify="right")
    start = paper.rows.get(reference or "")
    for name, pairs in paper.rows.items():
        cells = []
        for index, (iou, biou) in enumerate(pairs):
            left = f" ({100 * (100 - biou) / (100 - start[index][1]):.0f})" if start else ""
            cells.append(f"{iou:.1f} / {biou:.1f}{left}")
        table.add_row(Text(name), *cells)
    return table


def memory_line(averaged: Sequence[Row], sweep: str) -> str | None:
    """How far memory moves along a sweep, in a sentence; None if nothing of it finished."""
    rows = [row for row in averaged if row.variant.sweep == sweep]
    pairs = [(row.figures["peak_memory_mb"], row.figures["own_memory_mb"]) for row in rows]
    peaks, own = ([value for value in column if value is not None] for column in zip(*pairs, strict=True))
    if not peaks or not own:
        return None
    return (
        f"Along {sweep} the peak memory moves from {min(peaks):.0f} to {max(peaks):.0f} MB "
        f"(own: {min(own):.0f} to {max(own):.0f})."
    )


def percent(value: float | None) -> str:
    """A share in percent."""
    return number(_percent(value), 1)


def _percent(share: float | None) -> float | None:
    return None if share is None else 100 * share
