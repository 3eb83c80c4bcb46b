"""Tables of README, pages and notes: ``python -m beags_benchmarks.studies.page_tables [captures.json ...]``.

Each given result of ``beags bench`` is reduced to its means, the extracted BIoU of each object, protocol, command,
commit and machine in docs/results. Then every table of ``TABLES`` is rewritten between its two marks from these files,
which are the only source of its numbers.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.report import number, write_json
from beags_benchmarks.experiments.results import MEAN
from beags_plugin.evaluation.metrics import mean
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

ROOT = Path(__file__).resolve().parents[3]  # this clone, whose pages are written
END = "<!-- end of the table -->\n"
MOST_ROWS = 8

Figure = tuple[str, int, float]
"""Name in a row, digits, factor."""
BIOU: Figure = ("extracted_biou_after", 1, 100.0)
SPILL: Figure = ("extracted_spill_after", 1, 100.0)
RENDERED: Figure = ("rendered_biou_after", 1, 100.0)
FITTED: Figure = ("psnr_fit_after", 2, 1.0)
SECONDS: Figure = ("cpu_seconds", 0, 1.0)
ALL_SECONDS: Figure = ("cpu_seconds total", 0, 1.0)
LEFT: Figure = ("error_left", 0, 100.0)
"""Share of the BIoU error of ``REFERENCE`` that is left, which the rows of a file do not hold."""
REFERENCE = "assignment alone"
BEAR, DIGGER = "bear, salient", "kitchen, salient"

Column = tuple[str, str, Figure]
"""File of docs/results without ".json", scene in that file, figure of the scene."""


@dataclass(frozen=True)
class PageTable:
    """A table of one page: a line for each row of a result, a column for each figure of a scene.

    page: path below the root. name: name in its marks. corner: the first cell, the scene of all columns or "".
    columns: heading to column, with one number in each cell. rows: names of the results' rows.
    """

    page: str
    name: str
    corner: str
    columns: Mapping[str, Column]
    rows: Sequence[str]

    @property
    def begin(self) -> str:
        """Return the line before the table."""
        return f"<!-- table {self.name}, made by python -m beags_benchmarks.studies.page_tables -->\n"


def _of_scene(file: str, scene: str, figures: Mapping[str, Figure]) -> dict[str, Column]:
    return {heading: (file, scene, figure) for heading, figure in figures.items()}


CAPTURES = {"bear, 400 pixels": ("captures-bear", BEAR), "digger, 480 pixels": ("captures-kitchen", DIGGER)}
"""Name in README and its curve to file and scene of a capture."""
_ALL = {
    "BIoU, %": BIOU,
    "spill, %": SPILL,
    "BIoU in the scene, %": RENDERED,
    "PSNR, dB": FITTED,
    "CPU seconds": SECONDS,
}
_COSTS = {"BIoU, %": BIOU, "spill, %": SPILL, "PSNR, dB": FITTED, "CPU seconds": SECONDS}
_NEAR = {
    "PSNR, dB": ("close_up_psnr_after", 2, 1.0),
    "SSIM": ("close_up_ssim_after", 3, 1.0),
    "BIoU, %": ("close_up_biou_after", 1, 100.0),
    "whole photo, dB": FITTED,
    "CPU seconds in all": ALL_SECONDS,
}
_OF_BASES = {"BIoU, %": BIOU, "BIoU in the scene, %": RENDERED, "PSNR, dB": FITTED, "CPU seconds in all": ALL_SECONDS}
_REFINED = (
    "assignment alone",
    "as long as beags-fast, neither loss",
    "beags-fast",
    "as long as beags-refine, neither loss",
    "beags-refine",
    "as long as the paper, neither loss",
    "the paper's losses",
)
_LONG = (
    "assignment alone",
    "as long as the paper, neither loss",
    "the paper's losses",
    "as long as beags-refine, neither loss",
    "beags-refine",
)
_EXACTNESS = {
    "error of colours, 1e-6": ("color_error", 2, 1e6),
    "of the worst image": ("image_error", 1, 1e6),
    "of the worst gradient": ("gradient_error", 1, 1e6),
    "CPU ms": ("cpu_ms", 0, 1.0),
}
_CHOICES = ("200 steps (beags-fast)", "50 steps", "800 steps", "k / 8", "k x 8", "Z = 5", "Z = 100", "no reprojection")
_COMPARED = (
    "assignment alone",
    "flashsplat",
    "gaussiancut",
    "trace3d",
    "objectgs",
    "cob-gs, one scene",
    "the paper's losses, same masks",
    "beags-fast, same masks",
)
TABLES: tuple[PageTable, ...] = (
    PageTable(
        "README.md",
        "captures",
        "",
        {
            "bear: BIoU, %": ("captures-bear", BEAR, BIOU),
            "bear: seconds": ("captures-bear", BEAR, SECONDS),
            "digger: BIoU, %": ("captures-kitchen", DIGGER, BIOU),
            "digger: seconds": ("captures-kitchen", DIGGER, SECONDS),
        },
        ("assignment alone", "the paper's losses", "beags-fast", "beags-refine"),
    ),
    *(
        PageTable("docs/results.md", file, name, _of_scene(file, scene, _ALL), _REFINED)
        for name, (file, scene) in CAPTURES.items()
    ),
    PageTable(
        "docs/results.md",
        "captures-garden",
        "vase and table, 400 pixels",
        _of_scene("captures-garden", "garden, picked", _ALL),
        (*_REFINED[:3], *_REFINED[-2:]),
    ),
    PageTable(
        "docs/results.md",
        "captures-fruit",
        "apple and banana, 400 pixels",
        _of_scene("captures-fruit", "fruit, given", _ALL),
        _REFINED[:3],
    ),
    PageTable(
        "notes/refinement-on-captures.md",
        "captures-skull",
        "skull, 400 pixels",
        _of_scene("captures-skull", "dtu_skull, given", _ALL),
        _REFINED[:3],
    ),
    PageTable(
        "notes/refinement-on-captures.md",
        "error-left",
        "error left, %",
        {
            "bear": ("captures-bear", BEAR, LEFT),
            "bear, picked masks": ("captures-picked-bear", "bear, picked", LEFT),
            "digger": ("captures-kitchen", DIGGER, LEFT),
            "digger, picked masks": ("captures-picked-digger", "kitchen, picked", LEFT),
            "vase and table": ("captures-garden", "garden, picked", LEFT),
            "apple and banana": ("captures-fruit", "fruit, given", LEFT),
            "skull": ("captures-skull", "dtu_skull, given", LEFT),
        },
        ("beags-fast",),
    ),
    PageTable(
        "notes/refinement-on-captures.md",
        "room-768",
        "room, 768 x 576",
        _of_scene("room-768", "room768", _ALL),
        (*_REFINED[:3], *_REFINED[-2:]),
    ),
    *(
        PageTable(
            "notes/refinement-on-captures.md",
            f"picked-{name}",
            f"{name}, 260 pixels",
            _of_scene(f"captures-picked-{name}", f"{scene}, picked", _ALL),
            (*_REFINED[:3], *_REFINED[-2:]),
        )
        for name, scene in {"bear": "bear", "digger": "kitchen"}.items()
    ),
    PageTable(
        "docs/results.md",
        "captures-length",
        "digger, 779 pixels",
        _of_scene("captures-length", DIGGER, _ALL),
        _LONG,
    ),
    PageTable(
        "docs/results.md",
        "room-1024",
        "generated room, 1,024 x 768",
        _of_scene("room-1024", "room1024", _ALL),
        _LONG,
    ),
    *(
        PageTable(
            "notes/refinement-on-captures.md",
            table,
            f"{name}, 260 pixels",
            _of_scene(file, scene, _COSTS),
            _CHOICES,
        )
        for table, name, file, scene in (
            ("trade-off", "digger", "trade-off-kitchen", DIGGER),
            ("trade-off-bear", "bear", "trade-off-bear", BEAR),
        )
    ),
    PageTable(
        "notes/refinement-on-captures.md",
        "bases",
        "digger, 260 pixels",
        _of_scene("trade-off-kitchen", DIGGER, _OF_BASES),
        (
            "200 steps (beags-fast)",
            "base: no wider limits far away",
            "base: free space not cleared",
            "base: large Gaussians go",
            "base: no normal consistency",
            "base: with distortion",
        ),
    ),
    *(
        PageTable(
            "notes/focus.md",
            f"focus-{scene}",
            name,
            _of_scene("captures-focus", f"{scene}, picked", _NEAR),
            ("whole photos", "close-ups too (beags-fast)"),
        )
        for scene, name in {"bear": "bear", "kitchen": "digger", "garden": "vase and table"}.items()
    ),
    PageTable(
        "docs/comparison.md",
        "comparison-bear",
        "bear, 260 pixels",
        _of_scene("comparison-bear", BEAR, _ALL),
        _COMPARED,
    ),
    PageTable(
        "docs/comparison.md",
        "comparison-kitchen",
        "digger, 260 pixels",
        _of_scene("comparison-kitchen", DIGGER, _ALL),
        _COMPARED,
    ),
    PageTable(
        "notes/speed.md",
        "rasterizers",
        "10,000 Gaussians, 320 x 240",
        _of_scene("rasterizers", "10k/320x240", _EXACTNESS),
        ("native, float32", "torch, float32", "native, float64"),
    ),
)
_SOURCE = ("experiment", "preset", "reference", "command", "commit", "machine", "torch", "busy", "quick", "protocol")
_METRICS = (
    "extracted_iou_after",
    "extracted_biou_after",
    "worst_biou_after",
    "psnr_after",
    "psnr_shown_after",
)
_ROW = ("scene", "seed", "variant", "failed", "failures", "error_left", "lost_biou", "shown_after", "ssim_after",
        "rendered_iou_after", "rendered_biou_after", "rendered_covered_after", "extracted_spill_before",
        "extracted_spill_after", "psnr_fit_before", "psnr_fit_after",
        "close_up_biou_after", "close_up_psnr_after", "close_up_ssim_after", "steps", "cpu_seconds",
        "cpu_seconds total", "own_memory_mb", "peak_memory_mb", "objects")  # fmt: skip
_OF_OBJECTS = "extracted_biou_after"


def reduced(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the reduced result of ``beags bench``: its source, means, and the means of each scene.

    Each row of a scene has "objects", {name: extracted BIoU, or None}, where the result has rows of objects.
    """
    objects: dict[tuple[Any, ...], dict[str, float | None]] = {}
    for line in report["rows"]:
        if (name := line.get("object", MEAN)) != MEAN:
            value = line[_OF_OBJECTS]
            objects.setdefault(_place(line), {})[name] = None if value is None else round(value, 4)

    def row(full: Mapping[str, Any]) -> dict[str, Any]:
        values = {name: full[name] for name in (*_ROW, *_METRICS) if full.get(name) is not None}
        return {name: round(value, 6) if isinstance(value, float) else value for name, value in values.items()}

    source = {name: report[name] for name in _SOURCE if name in report}
    if "command" in source:
        source["command"] = _without_places(source["command"])
    return {
        **source,
        "means": [row(mean) for mean in report["means"]],
        "rows": [
            row({"objects": objects.get(_place(line)), **line})
            for line in report["rows"]
            if line.get("object", MEAN) == MEAN
        ],
    }


def _without_places(command: str) -> str:
    """Return a command without ``--output`` and the folders of its data, which belong to the machine."""
    return re.sub(r"(?<=\s)/\S*/(?=[^/\s])", "", re.sub(r"\s--output\s+\S+", "", command))


def _place(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["scene"], row.get("seed"), row["variant"]


def lines_of(table: PageTable, folder: Path) -> str:
    """Return a table in Markdown, of means over seeds, from the files of ``folder``.

    Raises ``UserError`` for missing rows.
    """
    lines = [[table.corner, *table.columns], ["---"] * (1 + len(table.columns))]
    for name in table.rows:
        cells = []
        for file, scene, (figure, digits, factor) in table.columns.values():
            path = folder / f"{file}.json"
            rows = _rows_of(path, name, scene)
            failed = any(row.get("failed") for row in rows)
            value = _error_left(path, rows, scene) if figure == LEFT[0] else _mean(rows, figure)
            cells.append("failed" if failed else number(value, digits, factor))
        lines.append([f"`{name}`" if name.startswith("beags") and " " not in name else name, *cells])
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


def _mean(rows: Sequence[Mapping[str, Any]], figure: str) -> float | None:
    """Return the mean of a figure over seeds; None where one lacks it."""
    figures = [row.get(figure) for row in rows]
    return None if None in figures else mean(figures)


def _error_left(path: Path, rows: Sequence[Mapping[str, Any]], scene: str) -> float | None:
    """Return the error of the mean BIoU over that of ``REFERENCE``."""
    found, before = (_mean(each, BIOU[0]) for each in (rows, _rows_of(path, REFERENCE, scene)))
    return None if found is None or before is None else (1.0 - found) / (1.0 - before)


def _rows_of(path: Path, name: str, scene: str) -> list[Mapping[str, Any]]:
    """Return the rows of a variant on a scene, one for each seed."""
    rows = json.loads(path.read_text())["rows"]
    wanted = [row for row in rows if (row["variant"], row["scene"], row.get("object", MEAN)) == (name, scene, MEAN)]
    if not wanted:
        raise UserError(f"{path} has no figures of {name!r} on {scene!r}: name a whole result of beags bench.")
    return wanted


def write_tables(root: Path = ROOT) -> None:
    """Rewrite every table in its page; raises ``UserError`` for a page without its marks."""
    for table in TABLES:
        page = root / table.page
        before, begin, rest = page.read_text().partition(table.begin)
        _, end, after = rest.partition(END)
        if not (begin and end):
            raise UserError(
                f"{page} lacks the lines {table.begin.strip()} and {END.strip()}: put them around the table."
            )
        lines = lines_of(table, root / "docs" / "results")
        write_text_atomically(f"{before}{begin}\n{lines}\n{end}{after}", page)


def main(arguments: Sequence[str], root: Path = ROOT) -> None:
    """Reduce the given results into docs/results and write all tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", nargs="*", metavar="[NAME=]FILE", help="NAME: of the file in docs/results")
    for argument in parser.parse_args(arguments).results:
        name, _, file = argument.rpartition("=")
        path = Path(file)
        report = json.loads(path.read_text())
        if report.get("quick"):
            raise UserError(f"{path} is of --quick, whose figures mean nothing: run the whole experiment.")
        write_json(root / "docs" / "results" / f"{name or path.stem}.json", reduced(report))
    write_tables(root)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(str(error))
