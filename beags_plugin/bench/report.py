"""What every measurement leaves behind: JSON, CSV, a table, a picture, and where its figures come from."""

from __future__ import annotations

import csv
import json
import math
import shlex
import sys
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.bench.provenance import commit, describe_machine
from beags_plugin.system.errors import writing
from beags_plugin.system.whole_files import write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table


def provenance() -> dict[str, Any]:
    """{"command", "commit", "machine", "torch"} of this process."""
    import torch

    return {
        "command": shlex.join(["beags", *sys.argv[1:]]),
        "commit": commit(),
        "machine": describe_machine(),
        "torch": torch.__version__,
    }


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write the report; its folder is made."""
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_whole(path, lambda file: file.write(text.encode()))


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows that all have the columns of the first; its folder is made."""
    text = StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [])
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, lambda file: file.write(text.getvalue().encode()))


def plain_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """A table for a terminal; the first column is text, the others are figures."""
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", box=SIMPLE)
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left")
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def number(value: float | None, digits: int) -> str:
    """A figure, or a dash where there is none."""
    return "–" if value is None else f"{value:.{digits}f}"


def new_figure(columns: int, rows: int = 1, size: tuple[float, float] = (4.4, 3.6)) -> tuple[Figure, Any]:
    """A figure that needs no screen, and its axes [rows][columns]; size: of each, in inches."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(
        rows, columns, figsize=(size[0] * columns, size[1] * rows), squeeze=False, layout="constrained"
    )


def save_figure(path: Path, figure: Figure) -> None:
    """Write the picture as PNG (or what the suffix says); its folder is made."""
    from matplotlib import pyplot

    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110)
    pyplot.close(figure)


def log_slope(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Least-squares slope of log y over log x: 0 is flat, 1 linear; None with fewer than two positive points."""
    points = [(math.log(a), math.log(b)) for a, b in zip(x, y, strict=True) if a > 0 and b > 0]
    if len({a for a, _ in points}) < 2:
        return None
    mean_x, mean_y = (math.fsum(column) / len(points) for column in zip(*points, strict=True))
    above = math.fsum((a - mean_x) * (b - mean_y) for a, b in points)
    return above / math.fsum((a - mean_x) ** 2 for a, _ in points)
