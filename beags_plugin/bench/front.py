"""The Pareto front: the variants that no other beats in both cost and quality."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from beags_plugin.bench.experiment import Experiment
from beags_plugin.bench.point_labels import Point, label_points
from beags_plugin.bench.report import new_figure, save_figure, scale_axis
from beags_plugin.bench.results import ResultRow, means

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TOTAL = ("cpu_seconds total", "CPU seconds, base and refinement")
REFINEMENT = ("cpu_seconds", "CPU seconds after the base, which all share")
MEMORY = ("peak_memory_mb", "peak memory, MB")
QUALITIES = (("extracted_biou_after", "extracted BIoU, %", 100.0), ("psnr_after", "PSNR, dB", 1.0))
FRONT, BEATEN = "#d94801", "#2171b5"


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


def costs(rows: Sequence[ResultRow]) -> tuple[tuple[str, str], ...]:
    """Return the costs to plot, each with its title: seconds and memory.

    The seconds of a base that all variants share would hide the differences between them, and move no front.
    """
    shared = all(row.variant.base == rows[0].variant.base for row in rows)
    return (REFINEMENT if shared else TOTAL, MEMORY)


@dataclass(frozen=True)
class Panel:
    """A drawn panel: its front, its points with their numbers, the front's first, and the corners of its line."""

    axes: Axes
    front: list[ResultRow]
    points: list[Point]
    corners: list[tuple[float, float]]


def plot_front(path: Path, experiment: Experiment, rows: Sequence[ResultRow]) -> None:
    """Plot the mean of every variant: a panel for every pair of a cost and a quality.

    Points bear numbers, with a list of the variants beside them: names would cover each other. In that list,
    names on the first panel's front have its colour.
    """
    averaged = [row for row in means(rows) if not row.failed]
    figure, axes = new_figure(2, len(QUALITIES), size=(6.5, 5.0))
    panels = []
    for line, (quality, quality_title, factor) in enumerate(QUALITIES):
        for column, (cost, cost_title) in enumerate(costs(averaged)):
            panels.append(_panel(axes[line, column], averaged, cost, quality, factor))
            axes[line, column].set_xlabel(cost_title)
            axes[line, column].set_ylabel(quality_title)
    names = [f"{number}  {row.variant.name}" for number, row in enumerate(averaged, start=1)]
    handles = [axes[0, 0].plot([], [], " ")[0] for _ in names]
    colors = [FRONT if row in panels[0].front else "black" for row in averaged]
    figure.legend(
        handles, names, loc="outside right upper", handlelength=0, handletextpad=0, fontsize="small", labelcolor=colors
    )
    figure.suptitle(f"{experiment.description} Orange: the Pareto front.")
    figure.canvas.draw()  # the layout, in which labels have their places
    figure.set_layout_engine("none")
    for panel in panels:
        label_points(panel.axes, panel.points, panel.corners)
    save_figure(path, figure)


def _panel(axes: Axes, rows: Sequence[ResultRow], cost: str, quality: str, factor: float) -> Panel:
    front = pareto_front(rows, cost, quality)
    points, corners = [], []
    for number, row in enumerate(rows, start=1):
        x, y = row.figures[cost], row.figures[quality]
        if x is not None and y is not None:
            color = FRONT if row in front else BEATEN
            axes.plot(x, factor * y, "o", ms=4, color=color, zorder=2 + (row in front))
            points.append((x, factor * y, str(number), color))
    for row in front:
        x, y = row.figures[cost] or 0.0, factor * (row.figures[quality] or 0.0)
        corners += [(x, corners[-1][1])] if corners else []
        corners.append((x, y))
    axes.plot([x for x, _ in corners], [y for _, y in corners], color=FRONT, lw=1, zorder=1)
    scale_axis(axes.set_xscale, [x for x, *_ in points])
    if axes.get_xscale() == "log":
        axes.xaxis.set_major_formatter("{x:g}")
    axes.margins(0.08)
    return Panel(axes, front, sorted(points, key=lambda point: point[3] != FRONT), corners)
