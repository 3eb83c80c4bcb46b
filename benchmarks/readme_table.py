"""README's table of results: ``python -m benchmarks.readme_table [outputs/bench/presets.json ...]``.

Each given result of ``beags bench`` is reduced to its means, the extracted BIoU of each object, protocol, command,
commit and machine in docs/results. Then the lines between README's two markers are written anew from the files there,
which are the only source of its figures.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from beags_plugin.bench.report import number, write_json
from beags_plugin.bench.results import MEAN
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = "<!-- made by python -m benchmarks.readme_table -->\n", "<!-- end of the table -->\n"
CAPTURED = ("assignment alone", "the paper's losses", "beags-fast", "beags-refine")
GROUPS: tuple[tuple[str, str, str, tuple[str, ...]], ...] = (
    ("a bear, masks from photos alone", "captures", "bear, salient", CAPTURED),
    ("a digger (kitchen), masks from photos alone", "captures", "kitchen, salient", CAPTURED),
)
"""What a group of rows is called, its file in docs/results, the scene or the family of generated scenes there, and its
variants (or all)."""
WORST = "worst_biou_after"
COLUMNS: tuple[tuple[str, tuple[str, ...], int, float], ...] = (
    ("extracted IoU, BIoU, %", ("extracted_iou_after", "extracted_biou_after"), 1, 100.0),
    ("spill, %", ("extracted_spill_after",), 1, 100.0),
    ("PSNR after colour fit, dB", ("psnr_fit_after",), 2, 1.0),
    ("CPU seconds after the base", ("cpu_seconds",), 0, 1.0),
)
"""Head, figures, digits, factor; a column without figures is left out."""
_SOURCE = ("experiment", "preset", "reference", "command", "commit", "machine", "torch", "busy", "quick", "protocol")
_KEPT = (
    WORST,
    "psnr_after",
    "psnr_shown_after",
    "removal_psnr_after",
    "removal_psnr_shown_after",
)  # Other tables show them.
_ROW = ("scene", "seed", "variant", "failed", "failures", "error_left", "lost_biou", "shown_after", "ssim_after",
        "rendered_iou_after", "rendered_biou_after", "extracted_spill_before", "extracted_spill_after",
        "psnr_fit_before", "psnr_fit_after", "removal_ssim_after", "removal_remains_after", "steps",
        "cpu_seconds", "cpu_seconds total", "own_memory_mb", "peak_memory_mb", "objects")  # fmt: skip
_OF_OBJECTS = "extracted_biou_after"


def reduced(report: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is kept of a result of ``beags bench``: its source, means, and the means of each scene.

    Each row of a scene has "objects", {name: extracted BIoU, or None}, where the result has rows of objects.
    """
    objects: dict[tuple[Any, ...], dict[str, float | None]] = {}
    for line in report["rows"]:
        if (name := line.get("object", MEAN)) != MEAN:
            value = line[_OF_OBJECTS]
            objects.setdefault(_place(line), {})[name] = None if value is None else round(value, 4)
    kept = (*_ROW, *_KEPT, *(figure for _, figures, *_ in COLUMNS for figure in figures))

    def row(full: Mapping[str, Any]) -> dict[str, Any]:
        found = {name: full[name] for name in kept if full.get(name) is not None}
        return {name: round(value, 6) if isinstance(value, float) else value for name, value in found.items()}

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
    """Return a command without ``--output`` and the folders of its data, which are the machine's own."""
    return re.sub(r"(?<=\s)/\S*/(?=[^/\s])", "", re.sub(r"\s--output\s+\S+", "", command))


def _place(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return row["scene"], row.get("seed"), row["variant"]


def table(folder: Path) -> str:
    """Return the table of ``GROUPS`` in Markdown, from the files of ``folder``; raises ``UserError`` for what lacks."""
    groups = [(title, name, _rows(folder / f"{name}.json", scene, chosen)) for title, name, scene, chosen in GROUPS]
    known = {figure for *_, rows in groups for row in rows for figure, value in row.items() if value is not None}
    columns = [column for column in COLUMNS if known & set(column[1])]
    lines = [["scene", "", *(head for head, *_ in columns)], ["---"] * (2 + len(columns))]
    for title, name, rows in groups:
        scene = f"{title} ([figures](docs/results/{name}.json))"
        for row in rows:
            cells = [", ".join(number(row.get(f), digits, factor) for f in fs) for _, fs, digits, factor in columns]
            variant = row["variant"]
            label = f"`{variant}`" if variant.startswith("beags") and " " not in variant else variant
            lines.append([scene, label, *cells])
            scene = ""
    return "".join(f"| {' | '.join(line)} |\n".replace("|  |", "| |") for line in lines)


def _rows(path: Path, scene: str, variants: Sequence[str]) -> list[dict[str, Any]]:
    report = json.loads(path.read_text())
    seeded = re.compile(re.escape(scene) + r"( \d+)?")  # of a family, "room 100"
    of_variant: dict[str, list[Mapping[str, Any]]] = {}
    for row in report["rows"]:
        if row.get("object", MEAN) == MEAN and seeded.fullmatch(row["scene"]):
            of_variant.setdefault(row["variant"], []).append(row)
    found = {name: _mean(group) for name, group in of_variant.items()}
    if missing := [name for name in variants or [""] if name and name not in found] or ([] if found else [scene]):
        raise UserError(f"{path} has no figures of {missing[0]!r}: name a whole result of beags bench.")
    return [found[name] for name in variants or found]


def _mean(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the means of one variant's rows, and its worst object of all."""
    mean: dict[str, Any] = {"variant": rows[0]["variant"]}
    for figure in {name for row in rows for name, value in row.items() if isinstance(value, float)}:
        known = [row[figure] for row in rows if row.get(figure) is not None]
        mean[figure] = min(known) if figure == WORST else sum(known) / len(known)
    return mean


def main(arguments: Sequence[str], root: Path = ROOT) -> None:
    """Reduce the named results into docs/results, and write README's table."""
    folder, readme = root / "docs" / "results", root / "README.md"
    for path in map(Path, arguments):
        report = json.loads(path.read_text())
        if report.get("quick"):
            raise UserError(f"{path} is of --quick, whose figures mean nothing: run the experiment whole.")
        write_json(folder / path.name, reduced(report))
    before, _, rest = readme.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    if not end:
        raise UserError(f"{readme} lacks the lines {BEGIN.strip()} and {END.strip()}: put them around the table.")
    write_text_atomically(f"{before}{BEGIN}\n{table(folder)}\n{END}{after}", readme)


if __name__ == "__main__":
    try:
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(str(error))
