"""An experiment's rows as tables for a terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from beags_benchmarks.experiments.experiment import Experiment, PaperFigures
from beags_benchmarks.experiments.report import new_table, number, plain_table
from beags_benchmarks.experiments.results import STAGES, ResultRow, error_left, find_reference, means, protocol_of

if TYPE_CHECKING:
    from rich.table import Table

_COLUMNS = (  # head, figure, digits, factor
    ("extracted\nIoU", "extracted_iou_after", 1, 100.0),
    ("\nBIoU", "extracted_biou_after", 1, 100.0),
    ("worst object\nBIoU", "worst_biou_after", 1, 100.0),
    ("\nlost", "lost_biou", 1, 100.0),
    ("spill, %\nbefore", "extracted_spill_before", 1, 100.0),
    ("\nafter", "extracted_spill_after", 1, 100.0),
    ("rendered\nIoU", "rendered_iou_after", 1, 100.0),
    ("\nBIoU", "rendered_biou_after", 1, 100.0),
    ("PSNR, dB\nbefore", "psnr_before", 2, 1.0),
    ("\nafter", "psnr_after", 2, 1.0),
    ("fit, dB\nbefore", "psnr_fit_before", 2, 1.0),
    ("\nafter", "psnr_fit_after", 2, 1.0),
    ("shown, dB\nbefore", "psnr_shown_before", 2, 1.0),
    ("\nafter", "psnr_shown_after", 2, 1.0),
    ("\n%", "shown_after", 1, 100.0),
    ("objects, dB\nbefore", "psnr_objects_before", 2, 1.0),
    ("\nafter", "psnr_objects_after", 2, 1.0),
    ("SSIM\nafter", "ssim_after", 3, 1.0),
    ("\nsteps", "steps", 0, 1.0),
    ("prepare\ns", "prepare", 1, 1.0),
    ("refine\ns", "seconds refinement", 1, 1.0),
    ("CPU\ns", "cpu_seconds", 1, 1.0),
    ("memory, MB\npeak", "peak_memory_mb", 0, 1.0),
    ("\nown", "own_memory_mb", 0, 1.0),
)


def tables(experiment: Experiment, rows: Sequence[ResultRow]) -> list[Table | str]:
    """Return the tables and sentences to print: means, scenes, the paper's figures, protocol, failures."""
    averaged = means(rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    title = f"{experiment.name}, {experiment.preset}: mean over {', '.join(scenes)}"
    printed: list[Table | str] = [_table(experiment, averaged, title)]
    if len(scenes) > 1:
        printed += [_table(experiment, [row for row in rows if row.scene == scene], scene) for scene in scenes]
    if experiment.paper is not None:
        printed.append(paper_table(experiment.paper, experiment.reference))
    printed.append("Worst object: the lowest extracted BIoU; lost: the most that an object loses by refinement.")
    printed.append("Spill: what an object drawn alone covers beyond a margin around its truth, in % of the truth.")
    printed.append("Fit: PSNR after the affine map of colours that fits each photo best.")
    printed.append("Objects: PSNR over the pixels of objects, but those next to the background.")
    printed.append("Seconds of stages are wall time; CPU: of the whole trial after its base, all threads.")
    printed.append("Memory: the peak of the trial's process, and what of it the loaded program does not take.")
    if any(row.variant.per_object for row in rows):
        printed.append("Costs of a scene per object are sums over the objects, each with a preparation of its own.")
    if experiment.reference is not None:
        printed.append(f"BIoU error left: (100 - extracted BIoU) as a share of that of {experiment.reference!r}.")
    printed += [line for sweep in experiment.sweeps if (line := memory_line(averaged, sweep)) is not None]
    if (protocol := protocol_of(rows)) is not None:
        printed.append(protocol)
    printed += [f"failed: {row.variant.name} on {row.scene}: {row.failed}" for row in rows if row.failed]
    return printed


def _table(experiment: Experiment, rows: Sequence[ResultRow], title: str) -> Table:
    from rich.text import Text

    relative = any(row.variant.sweep in experiment.relative_to_pixels for row in rows)
    masks = experiment.confidence and _any(rows, "mask_error_given")
    compared = experiment.reference is not None
    heads = ["per 10^6\npixels"] if relative else []
    heads += ["wrong, %\ngiven", "mask pixels\nused"] if masks else []
    heads += ["BIoU error\nleft, %"] if compared else []
    table = new_table(title, ["variant", *heads, *(head for head, *_ in _COLUMNS)])
    reference = find_reference(rows, experiment, rows[0].scene) if rows else None
    former = None
    for row in rows:
        if former is not None and (row.variant.sweep, row.variant.line) != former:
            table.add_section()
        former = (row.variant.sweep, row.variant.line)
        name = row.variant.name + (f" ({row.count} of {row.count + row.failures} scenes)" if row.failures else "")
        cells = [per_million_pixels(row, experiment)] if relative else []
        if masks:
            cells += [number(row.figures[f"mask_error_{kind}"], 2, 100.0) for kind in ("given", "used")]
        if compared:
            cells.append(number(error_left(row, reference), 1, 100.0))
        table.add_row(Text(name), *cells, *(["failed"] if row.failed else _cells(row)))
    return table


def _any(rows: Sequence[ResultRow], figure: str) -> bool:
    return any(row.figures[figure] is not None for row in rows)


def per_million_pixels(row: ResultRow, experiment: Experiment) -> str:
    """Return the position on a sweep's axis per million training pixels, or a dash for other sweeps."""
    pixels = row.figures["training_pixels"]
    if row.variant.sweep not in experiment.relative_to_pixels or not pixels or row.variant.x is None:
        return "–"
    return f"{1e6 * row.variant.x / pixels:.3g}"


def _cells(row: ResultRow) -> list[str]:
    prepare = sum(value for stage in STAGES[1:-1] if (value := row.figures[f"seconds {stage}"]) is not None)
    figures = {**row.figures, "prepare": prepare}
    return [number(figures[name], digits, factor) for _, name, digits, factor in _COLUMNS]


def paper_table(paper: PaperFigures, reference: str | None) -> Table:
    """Return a table of the paper's figures, with a title that says so."""
    title = f"For comparison, the paper's figures, not ours: {paper.source}; IoU / BIoU, % (BIoU error left, %)"
    start = paper.rows.get(reference or "")
    rows = []
    for name, pairs in paper.rows.items():
        cells = []
        for index, (iou, biou) in enumerate(pairs):
            share = f" ({100 * (100 - biou) / (100 - start[index][1]):.0f})" if start else ""
            cells.append(f"{iou:.1f} / {biou:.1f}{share}")
        rows.append([name, *cells])
    return plain_table(title, ["variant", *paper.columns], rows)


def memory_line(averaged: Sequence[ResultRow], sweep: str) -> str | None:
    """Return a sentence with the range of memory along a sweep; None if all its trials failed."""
    figures = [row.figures for row in averaged if row.variant.sweep == sweep]
    peaks, own = ([v for f in figures if (v := f[name]) is not None] for name in ("peak_memory_mb", "own_memory_mb"))
    if not peaks or not own:
        return None
    return (
        f"Along {sweep} the peak memory moves from {min(peaks):.0f} to {max(peaks):.0f} MB "
        f"(own: {min(own):.0f} to {max(own):.0f})."
    )
