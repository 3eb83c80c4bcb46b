"""Tables of ``beags bench captures``: a row for each refinement, of each capture and in the mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from beags_benchmarks.experiments.captures.known import CAPTURES, SALIENT
from beags_benchmarks.experiments.report import number, plain_table
from beags_benchmarks.experiments.results import ResultRow, means, protocol_of

if TYPE_CHECKING:
    from rich.table import Table

COST = "psnr_cost"
_COLUMNS = (  # head, figure, digits, factor
    ("extracted\nIoU, %", "extracted_iou_after", 1, 100.0),
    ("\nBIoU, %", "extracted_biou_after", 1, 100.0),
    ("worst object\nBIoU, %", "worst_biou_after", 1, 100.0),
    ("\nspill, %", "extracted_spill_after", 1, 100.0),
    ("rendered\nBIoU, %", "rendered_biou_after", 1, 100.0),
    ("\ncovered, %", "rendered_covered_after", 1, 100.0),
    ("full size\nBIoU, %", "close_up_biou_after", 1, 100.0),
    ("\nPSNR, dB", "close_up_psnr_after", 2, 1.0),
    ("\nSSIM", "close_up_ssim_after", 3, 1.0),
    ("PSNR\ndB", "psnr_after", 2, 1.0),
    ("\nfitted, dB", "psnr_fit_after", 2, 1.0),
    ("\ncost, dB", COST, 2, 1.0),
    ("CPU, s\nafter base", "cpu_seconds", 0, 1.0),
    ("\nin all", "cpu_seconds total", 0, 1.0),
)
_SCORED = {capture.name for capture in CAPTURES if capture.objects or capture.own_truth}


def tables(rows: Sequence[ResultRow]) -> list[Table | str]:
    """Return the tables: means over the scored captures by kind of masks, each capture, and the legend."""
    scenes = list(dict.fromkeys(row.scene for row in rows))
    printed: list[Table | str] = []
    for title, names in groups(scenes).items():
        if len(names) > 1:
            printed.append(_table(f"{title}: mean over {'; '.join(names)}", mean_rows(rows, names)))
    printed += [_table(scene, [row for row in rows if row.scene == scene]) for scene in scenes]
    printed.append("Worst object: the lowest extracted BIoU. Fitted: after the best colour fit of each photo.")
    printed.append("Covered: the share of an object's pixels that the rendered scene gives to something else.")
    printed.append("Full size: the object's box in held-out photos at the size of their files.")
    printed.append("Cost: fitted PSNR of the row's control minus its own.")
    printed.append("CPU: of the whole trial, all threads; what making the masks takes is in neither.")
    if (protocol := protocol_of(rows)) is not None:
        printed.append(protocol)
    return printed + [f"failed: {row.variant.name} on {row.scene}: {row.failed}" for row in rows if row.failed]


def groups(scenes: Sequence[str]) -> dict[str, list[str]]:
    """Return the scored scenes by kind of masks; empty groups are left out."""
    scored = [scene for scene in scenes if scene.split(", ")[0] in _SCORED]
    salient = [scene for scene in scored if scene.endswith(f", {SALIENT}")]
    best = [scene for scene in scored if scene not in salient]
    return {title: names for title, names in (("best masks", best), ("masks from photos alone", salient)) if names}


def mean_rows(rows: Sequence[ResultRow], scenes: Sequence[str]) -> list[ResultRow]:
    """Return the means of each row over these scenes."""
    return means([row for row in rows if row.scene in scenes])


def psnr_cost(row: ResultRow, rows: Sequence[ResultRow]) -> float | None:
    """Return the fitted PSNR of a row's control in the same scene minus the row's own, dB; None if unknown.

    Means over different numbers of scenes are not compared.
    """
    same = (row.scene, row.seed, row.count)
    of_control = (
        other.figures["psnr_fit_after"]
        for other in rows
        if other.variant.name == row.variant.control and (other.scene, other.seed, other.count) == same
    )
    control, own = next(of_control, None), row.figures["psnr_fit_after"]
    return None if control is None or own is None else control - own


def _table(title: str, rows: Sequence[ResultRow]) -> Table:
    figures = [{**row.figures, COST: psnr_cost(row, rows)} for row in rows]
    columns = [column for column in _COLUMNS if any(each.get(column[1]) is not None for each in figures)]
    lines = []
    for row, own in zip(rows, figures, strict=True):
        lacking = f" ({row.count} of {row.count + row.failures} scenes)" if row.failures else ""
        cells = [number(own.get(name), digits, factor) for _, name, digits, factor in columns]
        lines.append([row.variant.name + lacking, *(["failed"] if row.failed else cells)])
    return plain_table(title, ["row", *(head for head, *_ in columns)], lines)
