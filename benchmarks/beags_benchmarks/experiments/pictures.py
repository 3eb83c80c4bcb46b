"""Plots of an experiment's rows: bars of variants, curves of sweeps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from beags_benchmarks.experiments.experiment import Experiment
from beags_benchmarks.experiments.report import new_figure, save_figure, scale_axis
from beags_benchmarks.experiments.results import ResultRow, means

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_BARS = (("extracted_iou_after", "extracted IoU, %"), ("extracted_biou_after", "extracted BIoU, %"))
_CURVES = (
    ("extracted_iou_after", "extracted IoU, %", 100.0),
    ("extracted_biou_after", "extracted BIoU, %", 100.0),
    ("psnr_after", "PSNR, dB", 1.0),
    ("cpu_seconds", "CPU after the base, s", 1.0),
    ("peak_memory_mb", "peak memory, MB", 1.0),
)
_PAPER_MARKS = "ovs^Dp*X"
_WIDTH, _HEIGHT = 4.4, 3.6  # inches of one diagram
_BAR_HEIGHT = 0.22  # inches, at which the names of many bars do not overlap
_FEW = 4  # most lines of a sweep for a legend within a diagram
_COLORS, _MARKS = 10, "osD^"


def plot_experiment(path: Path, experiment: Experiment, rows: Sequence[ResultRow]) -> None:
    """Plot a row of bars for the variants and a row of curves per sweep; the suffix of ``path`` gives the format.

    If there are only sweeps, diagrams without figures are left out.
    """
    variants = [row for row in rows if not row.variant.sweep]
    known = [curve for curve in _CURVES if any(row.figures[curve[0]] is not None for row in rows)]
    curves = _CURVES if variants or not known else tuple(known)
    height = 1 if variants else 0
    names = len({row.variant.name for row in variants})
    inches = max(_HEIGHT, _BAR_HEIGHT * names) if not experiment.sweeps else _HEIGHT
    figure, axes = new_figure(len(curves), height + len(experiment.sweeps), size=(_WIDTH, inches))
    if variants:
        for column, (metric, title) in enumerate(_BARS):
            _bars(axes[0, column], experiment, variants, metric, title, column, labels=column == 0)
        _bars(axes[0, 2], experiment, variants, "psnr_after", "PSNR, dB", None, labels=False)
        for column, (metric, title) in enumerate((_CURVES[3][:2], _CURVES[4][:2]), start=3):
            _bars(axes[0, column], experiment, variants, metric, title, None, labels=False)
    for line, sweep in enumerate(experiment.sweeps, start=height):
        for column, curve in enumerate(curves):
            _curves(axes[line, column], [row for row in rows if row.variant.sweep == sweep], sweep, *curve)
        _legend(axes[line])
    figure.suptitle(experiment.description)
    save_figure(path, figure)


def _bars(
    axes: Axes, experiment: Experiment, rows: Sequence[ResultRow], metric: str, title: str, paper: int | None,
    labels: bool,
) -> None:  # fmt: skip
    """Plot bars of means, a dot for each scene, and the paper's figures as hollow marks. paper: index in its pairs."""
    factor = 100.0 if title.endswith("%") else 1.0
    names = list(dict.fromkeys(row.variant.name for row in rows))
    place = {name: len(names) - 1 - index for index, name in enumerate(names)}
    low: list[float] = []
    for row in means(rows):
        if (value := row.figures[metric]) is not None:
            axes.barh(place[row.variant.name], factor * value, color="#9ecae1", zorder=1)
            low.append(factor * value)
    for row in rows:
        if (value := row.figures[metric]) is not None:
            axes.plot(factor * value, place[row.variant.name], ".", color="#08306b", zorder=3)
            low.append(factor * value)
    if paper is not None and experiment.paper is not None:
        for mark, (index, column) in zip(_PAPER_MARKS, enumerate(experiment.paper.columns), strict=False):
            points = [(pairs[index][paper], place[n]) for n, pairs in experiment.paper.rows.items() if n in place]
            if points:
                x, y = zip(*points, strict=True)
                axes.plot(x, y, mark, color="#d94801", fillstyle="none", label=f"the paper's {column}", zorder=2)
                low += x
        if labels and axes.get_legend_handles_labels()[0]:
            axes.figure.legend(loc="outside lower left", ncols=4, fontsize="small")
    if low and min(low) > 0:
        axes.set_xlim(left=0 if factor == 1.0 and "PSNR" not in title else 0.95 * min(low))
    axes.set_yticks(list(place.values()), list(place) if labels else [""] * len(place))
    axes.set_title(title)


def _curves(axes: Axes, rows: Sequence[ResultRow], sweep: str, metric: str, title: str, factor: float) -> None:
    """Plot means as thick lines, assignment alone dashed, scenes thin, with one colour for each line of the sweep."""
    lines = list(dict.fromkeys(row.variant.line for row in rows))
    for index, line in enumerate(lines):
        color, mark = f"C{index % _COLORS}", _MARKS[index // _COLORS % len(_MARKS)]
        of_line = [row for row in rows if row.variant.line == line]
        for scene, seed in dict.fromkeys((row.scene, row.seed) for row in of_line):
            points = _points([row for row in of_line if (row.scene, row.seed) == (scene, seed)], metric, factor)
            axes.plot(*points, lw=0.6, alpha=0.6, color=color)
        averaged = means(of_line)
        axes.plot(*_points(averaged, metric, factor), f"{mark}-", lw=2, ms=4, color=color, label=line or "refined")
        before = _points(averaged, metric.replace("_after", "_before"), factor)
        if metric.endswith("_after") and len(lines) <= _FEW:
            label = ", ".join(filter(None, [line, "assignment alone"]))
            axes.plot(*before, "--", lw=1.2, color=color, label=label)
    scale_axis(axes.set_xscale, [row.variant.x for row in rows])
    if title.startswith("CPU"):
        scale_axis(axes.set_yscale, [row.figures[metric] for row in rows])
    if title.startswith("peak"):
        axes.set_ylim(bottom=0)
    if axes.get_yscale() == "linear":
        axes.ticklabel_format(axis="y", useOffset=False)
    axes.set_xlabel(sweep)
    axes.set_title(title)


def _legend(axes: Sequence[Axes]) -> None:
    """Add the legend of a row of diagrams to the last one, of memory, which has room, or beside it if it is long."""
    if len(axes[0].get_legend_handles_labels()[0]) <= 2 * _FEW:
        axes[-1].legend(*axes[0].get_legend_handles_labels(), fontsize="x-small")
    else:
        axes[-1].legend(fontsize="x-small", loc="center left", bbox_to_anchor=(1.02, 0.5))


def _points(rows: Sequence[ResultRow], metric: str, factor: float) -> tuple[list[float], list[float]]:
    pairs = [(row.variant.x, row.figures[metric]) for row in rows]
    known = sorted((x, factor * y) for x, y in pairs if x is not None and y is not None)
    return [x for x, _ in known], [y for _, y in known]
