"""python -m benchmarks.scaling: time and memory of each stage against classes, views, Gaussians and pixels."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
import tyro
from rich.console import Console

from beags_plugin.bench.report import (
    new_figure,
    number,
    plain_table,
    provenance,
    save_figure,
    write_csv,
    write_json,
)
from beags_plugin.system.errors import UserError, print_user_errors_plainly
from beags_plugin.system.progress import progress_bar
from benchmarks.peak_memory import peak_mb_of
from benchmarks.scaling_scene import Sizes, make_scene
from benchmarks.scaling_stages import CHANNELS, STAGES, STEP, stages

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # paths may hold brackets
AXES = ("classes", "views", "gaussians", "pixels")
QUICK = {
    "base": Sizes(classes=2, views=3, gaussians=600, pixels=768),
    "classes": (1, 4), "views": (2, 4), "gaussians": (300, 600), "pixels": (768, 1728), "channels": 4, "calls": 1,
}  # fmt: skip


@dataclass(frozen=True)
class ScalingOptions:
    """Time and memory of a refinement step and of each stage before it against classes, views, Gaussians and pixels.

    channels: largest number of classes at which a step that renders a channel per class is measured too. calls:
    number of timings of each stage, in turn; the median counts. quick: tiny sizes, in seconds; figures mean nothing.
    output: folder of results. json, csv, picture: files; <output>/scaling.json and so on if left out.
    """

    classes: tuple[int, ...] = (1, 4, 16, 64, 256)
    views: tuple[int, ...] = (4, 8, 16, 32)
    gaussians: tuple[int, ...] = (2_500, 5_000, 10_000, 20_000)
    pixels: tuple[int, ...] = (4_800, 10_800, 19_200, 43_200)
    channels: int = 16
    calls: int = 3
    quick: bool = False
    output: Path = Path("outputs/bench")
    json: Path | None = None
    csv: Path | None = None
    picture: Path | None = None

    def check(self) -> None:
        """Raise ``UserError`` for a size that cannot be measured."""
        for axis in AXES:
            if len(getattr(self, axis)) < 2 or min(getattr(self, axis)) < 1:
                raise UserError(f"--{axis} needs two or more sizes of 1 or more: a slope is measured between them.")
        if max(self.classes) > 65_534:
            raise UserError("--classes goes up to 65534: masks hold no more ids.")
        if min(self.gaussians) < 8 or min(self.pixels) < 192:
            raise UserError("--gaussians must be 8 or more and --pixels 192 or more: else there is nothing to see.")
        if self.calls < 1:
            raise UserError("--calls must be 1 or more.")


@dataclass(frozen=True)
class StageRow:
    """One stage at one size: median of the wall times, peak growth of the process (None where it is unknown)."""

    axis: str
    size: int
    stage: str
    seconds: float
    memory_mb: float | None


@dataclass(frozen=True)
class Slope:
    """Least-squares slopes of log time and log memory over log size: 0 is flat, 1 linear."""

    axis: str
    stage: str
    time: float | None
    memory: float | None


def run_scaling(options: ScalingOptions) -> list[StageRow]:
    """Measure, print the tables of slopes, write the files; returns the rows."""
    options.check()
    base = Sizes()
    if options.quick:
        base = QUICK["base"]
        options = replace(options, **{name: value for name, value in QUICK.items() if name != "base"})
    rows: list[StageRow] = []
    for axis in AXES:
        rows += measure(axis, getattr(options, axis), base, options.channels, options.calls)
    found = slopes(rows)
    for table in tables(rows, found):
        CONSOLE.print(table)
    files = {kind: getattr(options, kind) or options.output / f"scaling.{end}" for kind, end in _FILES}
    write_json(
        files["json"],
        {
            "experiment": "scaling", **provenance(), "threads": torch.get_num_threads(), "base": asdict(base),
            "calls": options.calls, "rows": [asdict(row) for row in rows], "slopes": [asdict(s) for s in found],
        },
    )  # fmt: skip
    write_csv(files["csv"], [asdict(row) for row in rows])
    plot_scaling(files["picture"], rows)
    for kind, path in files.items():
        CONSOLE.print(f"{kind}: {path}")
    return rows


_FILES = (("json", "json"), ("csv", "csv"), ("picture", "png"))


def measure(axis: str, sizes: Sequence[int], base: Sizes, channels: int, calls: int) -> list[StageRow]:
    """Measure all stages at all sizes along one axis.

    Stages take turns, ``calls`` times each, so that other load of the machine affects all alike. A channel per class
    is rendered up to ``channels`` classes.
    """
    from beags_plugin.rasterizers import make_rasterizer

    rasterizer = make_rasterizer()
    work: dict[tuple[int, str], Callable[[], object]] = {}
    for size in sizes:
        scene = make_scene(replace(base, **{axis: size}), rasterizer)
        for stage, call in stages(scene, rasterizer, scene.num_classes <= channels + 1).items():
            work[size, stage] = call
    memory: dict[tuple[int, str], float | None] = {}
    times: dict[tuple[int, str], list[float]] = {key: [] for key in work}
    with progress_bar(f"Scaling with {axis}") as progress:
        for turn in range(calls + 1):
            for key, call in work.items():
                if turn == 0:  # warms up too
                    memory[key] = peak_mb_of(call)
                else:
                    start = time.perf_counter()
                    call()
                    times[key].append(time.perf_counter() - start)
            progress(turn + 1, calls + 1)
    return [
        StageRow(axis, size, stage, statistics.median(times[size, stage]), memory[size, stage]) for size, stage in work
    ]


def slopes(rows: Sequence[StageRow]) -> list[Slope]:
    """Return the slopes of each axis and stage."""
    found = []
    for axis in dict.fromkeys(row.axis for row in rows):
        for stage in STAGES:
            line = [row for row in rows if (row.axis, row.stage) == (axis, stage)]
            known = [row for row in line if row.memory_mb is not None]
            time_slope = log_slope([row.size for row in line], [row.seconds for row in line])
            memory = log_slope([row.size for row in known], [row.memory_mb or 0.0 for row in known])
            found.append(Slope(axis, stage, time_slope, memory))
    return found


def log_slope(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return the least-squares slope of log y over log x, or None with fewer than two positive points."""
    points = [(math.log(a), math.log(b)) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    if len({a for a, _ in points}) < 2:
        return None
    mean_x, mean_y = (math.fsum(column) / len(points) for column in zip(*points, strict=True))
    above = math.fsum((a - mean_x) * (b - mean_y) for a, b in points)
    return above / math.fsum((a - mean_x) ** 2 for a, _ in points)


def tables(rows: Sequence[StageRow], found: Sequence[Slope]):
    """Yield tables of the slopes of time and of memory, then of both at each number of classes."""
    by_place = {(slope.axis, slope.stage): slope for slope in found}
    axes = list(dict.fromkeys(slope.axis for slope in found))
    for kind in ("time", "memory"):
        lines = [[stage, *(number(getattr(by_place[axis, stage], kind), 2) for axis in axes)] for stage in STAGES]
        yield plain_table(f"Slope of {kind} (0 flat, 1 linear)", ("stage", *axes), lines)
    line = {(row.size, row.stage): row for row in rows if row.axis == "classes"}
    sizes = sorted({size for size, _ in line})
    for name, title, factor in (("seconds", "Milliseconds", 1000.0), ("memory_mb", "MB", 1.0)):
        cells = []
        for stage in STAGES:
            known = [getattr(line[size, stage], name) if (size, stage) in line else None for size in sizes]
            cells.append([stage, *(number(None if value is None else factor * value, 1) for value in known)])
        yield plain_table(f"{title} by number of classes", ("stage", *map(str, sizes)), cells)


def plot_scaling(path: Path, rows: Sequence[StageRow]) -> None:
    """Plot time above and memory below, a column for each axis, a line for each stage."""
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    axes = list(dict.fromkeys(row.axis for row in rows))
    figure, plots = new_figure(len(axes), 2, (3.6, 3.2))
    shown = (("seconds", "milliseconds", 1000.0), ("memory_mb", "peak memory, MB", 1.0))
    for line, (name, title, factor) in enumerate(shown):
        for plot, axis in zip(plots[line], axes, strict=True):
            for color, stage in enumerate(STAGES):
                known = [
                    (row.size, factor * value)
                    for row in rows
                    if (row.axis, row.stage) == (axis, stage) and (value := getattr(row, name))
                ]
                if known:
                    style = "s--" if stage == CHANNELS else "o-"
                    width = 2.5 if stage in (STEP, CHANNELS) else 1.2
                    plot.plot(
                        *zip(*known, strict=True), style, color=f"C{color}", label=stage, markersize=4, linewidth=width
                    )
            if plot is not plots[line][0]:
                plot.sharey(plots[line][0])
                plot.tick_params(labelleft=False)
            sizes = sorted({row.size for row in rows if row.axis == axis})
            plot.set_xscale("log")
            plot.set_yscale("log")
            plot.set_xticks(sizes, [f"{size / 1000:g}k" if size >= 1000 else str(size) for size in sizes])
            plot.minorticks_off()
            plot.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            plot.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            plot.grid(alpha=0.3)
            plot.set_xlabel("Gaussians" if axis == "gaussians" else axis)
        plots[line][0].set_ylabel(title)
    handles, names = plots[0][0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=len(STAGES), frameon=False)
    save_figure(path, figure)


if __name__ == "__main__":
    print_user_errors_plainly()
    run_scaling(tyro.cli(ScalingOptions))
