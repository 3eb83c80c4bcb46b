"""README's curve of CPU seconds against extracted BIoU: ``python -m beags_benchmarks.studies.cost_curve``.

Its data are the files of docs/results behind README's table.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.report import new_figure, save_figure
from beags_benchmarks.experiments.results import MEAN
from beags_benchmarks.studies.page_tables import CAPTURES, ROOT
from beags_plugin.system.digests import value_digest

LABELS = {
    "assignment alone": "assignment alone",
    "the paper's losses": "the paper's losses, 3,000 steps",
    "beags-refine": "beags-refine, 800 steps",
    "beags-fast": "beags-fast, 200 steps",
}
MARKS = {"assignment alone": "o", "the paper's losses": "s", "beags-refine": "^", "beags-fast": "D"}
COLORS = ("#d94801", "#2171b5", "#238b45", "#6a51a3")


Point = tuple[float, float, str]
"""CPU seconds, extracted BIoU in %, row."""


def curves(root: Path = ROOT) -> dict[str, list[Point]]:
    """Return the points of each capture, by seconds. Raises ``FileNotFoundError`` without the results."""
    found = {}
    for name, (file, scene) in CAPTURES.items():
        report = json.loads((root / "docs" / "results" / f"{file}.json").read_text())
        rows = {
            row["variant"]: row for row in report["rows"] if (row["scene"], row.get("object", MEAN)) == (scene, MEAN)
        }
        found[name] = sorted((rows[row]["cpu_seconds"], 100 * rows[row]["extracted_biou_after"], row) for row in LABELS)
    return found


def digest(root: Path = ROOT) -> str:
    """Return a digest of all points, which the picture keeps as its description."""
    return value_digest(curves(root))


def draw(root: Path = ROOT) -> Path:
    """Draw docs/images/cost.png; returns its path. Raises ``FileNotFoundError`` without the results."""
    figure, axes = new_figure(1, 1, size=(6.4, 3.6))
    panel: Any = axes[0, 0]
    for color, (name, points) in zip(COLORS, curves(root).items(), strict=False):
        panel.plot([x for x, *_ in points], [y for _, y, _ in points], color=color, lw=1, label=name)
        for x, y, row in points:
            panel.plot(x, y, MARKS[row], color=color, ms=6)
    for row, label in LABELS.items():
        panel.plot([], [], MARKS[row], color="grey", label=label)
    panel.set_xscale("log")
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set_xlabel("CPU seconds after the base")
    panel.set_ylabel("extracted BIoU, %")
    panel.grid(alpha=0.3)
    figure.legend(loc="outside right upper", fontsize="small")
    path = root / "docs" / "images" / "cost.png"
    save_figure(path, figure, digest(root))
    return path


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(draw())
