"""The Pareto front: the variants that no other beats in both cost and quality."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.bench.experiment import Experiment
from beags_plugin.bench.report import new_figure, save_figure
from beags_plugin.bench.results import ResultRow, means

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COSTS = (("cpu_seconds total", "CPU seconds, base and refinement"), ("peak_memory_mb", "peak memory, MB"))
QUALITIES = (("extracted_biou_after", "extracted BIoU, %", 100.0), ("psnr_after", "PSNR, dB", 1.0))


def pareto_front(rows: Sequence[ResultRow], cost: str, quality: str) -> list[ResultRow]:
    """Return the rows that no other beats, cheapest first: none is as cheap and as good, and better in one of the two.

    cost: figure to keep low. quality: figure to keep high. Rows that lack one of them are left out.
    """
    known = [(row, row.figures[cost], row.figures[quality]) for row in rows]
    points = [(row, c, q) for row, c, q in known if c is not None and q is not None]
    points.sort(key=lambda point: (point[1], -point[2]))
    front: list[tuple[ResultRow, float, float]] = []
    for point in points:
        if not front or point[2] > front[-1][2] or point[1:] == front[-1][1:]:
            front.append(point)
    return [row for row, _, _ in front]


def plot_front(path: Path, experiment: Experiment, rows: Sequence[ResultRow]) -> None:
    """Plot the mean of every variant: a panel for every pair of a cost and a quality.

    Points bear numbers, with a list of the variants beside them: names would cover each other.
    """
    figure, axes = new_figure(len(COSTS), len(QUALITIES), size=(6.5, 5.0))
    averaged = [row for row in means(rows) if not row.failed]
    for line, (quality, quality_title, factor) in enumerate(QUALITIES):
        for column, (cost, cost_title) in enumerate(COSTS):
            panel: Axes = axes[line, column]
            _panel(panel, averaged, cost, quality, factor)
            panel.set_xlabel(cost_title)
            panel.set_ylabel(quality_title)
    names = [f"{number}  {row.variant.name}" for number, row in enumerate(averaged, start=1)]
    handles = [axes[0, 0].plot([], [], " ")[0] for _ in names]
    figure.legend(handles, names, loc="outside right upper", handlelength=0, handletextpad=0, fontsize="small")
    figure.suptitle(f"{experiment.description} Line: the Pareto front.")
    save_figure(path, figure)


def _panel(axes: Axes, rows: Sequence[ResultRow], cost: str, quality: str, factor: float) -> None:
    front = pareto_front(rows, cost, quality)
    for number, row in enumerate(rows, start=1):
        x, y = row.figures[cost], row.figures[quality]
        if x is not None and y is not None:
            color = "#d94801" if row in front else "#6baed6"
            axes.plot(x, factor * y, "o", ms=4, color=color, zorder=2)
            axes.annotate(str(number), (x, factor * y), (3, 3), textcoords="offset points", fontsize="x-small")
    x = [row.figures[cost] or 0.0 for row in front]
    y = [factor * (row.figures[quality] or 0.0) for row in front]
    axes.step(x, y, where="post", color="#d94801", lw=1, zorder=1)
