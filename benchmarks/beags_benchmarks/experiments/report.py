"""Files, tables and plots of measurements, and the source of their numbers."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_benchmarks.provenance import command, commit, describe_machine
from beags_plugin.system.errors import writing
from beags_plugin.system.whole_files import write_text_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table

LINE = 4_000  # most characters of a row of JSON on one line
_LOGARITHMIC = 20.0  # ratio of values above which an axis is logarithmic


def provenance() -> dict[str, Any]:
    """Return {"command", "commit", "machine", "torch"} of this process."""
    import torch

    return {
        "command": command(),
        "commit": commit(),
        "machine": describe_machine(),
        "torch": torch.__version__,
    }


def write_json(path: Path, report: Mapping[str, Any]) -> None:
    """Write the report with one line for each row, and make its folder."""
    write_text_atomically(_json_lines(report, "") + "\n", path)


def _json_lines(value: Any, indent: str) -> str:
    """Return JSON in which each row of a list is one line, if it fits in ``LINE`` characters."""
    line = json.dumps(value, allow_nan=False)
    rows = isinstance(value, list | tuple) and any(isinstance(each, Mapping) for each in value)
    if not isinstance(value, Mapping | list | tuple) or (indent and not rows and len(line) <= LINE):
        return line
    inner = indent + " "
    if isinstance(value, Mapping):
        parts = [f"{json.dumps(str(key))}: {_json_lines(each, inner)}" for key, each in value.items()]
    else:
        parts = [_json_lines(each, inner) for each in value]
    first, last = "{}" if isinstance(value, Mapping) else "[]"
    return f"{first}\n" + ",\n".join(inner + part for part in parts) + f"\n{indent}{last}"


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows that all have the columns of the first, and make the folder."""
    text = StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else [])
    writer.writeheader()
    writer.writerows(rows)
    write_text_atomically(text.getvalue(), path)


def new_table(title: str, columns: Sequence[str]) -> Table:
    """Return an empty table for a terminal; the first column is text, the others are numbers."""
    from rich.box import SIMPLE
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(title), title_justify="left", box=SIMPLE, collapse_padding=True, pad_edge=False)
    for index, column in enumerate(columns):
        table.add_column(column, justify="right" if index else "left", no_wrap=not index)
    return table


def plain_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    """Return a table of these cells, without markup."""
    from rich.text import Text

    table = new_table(title, columns)
    for row in rows:
        table.add_row(*map(Text, row))
    return table


def number(value: float | None, digits: int, factor: float = 1.0) -> str:
    """Return a number times ``factor`` as text, or a dash for None."""
    return "–" if value is None else f"{factor * value:.{digits}f}"


def new_figure(columns: int, rows: int = 1, size: tuple[float, float] = (4.4, 3.6)) -> tuple[Figure, Any]:
    """Return a figure that needs no screen, and its axes [rows][columns]. size: inches of each axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(
        rows, columns, figsize=(size[0] * columns, size[1] * rows), squeeze=False, layout="constrained"
    )


def scale_axis(set_scale: Callable[[str], None], values: Sequence[float | None]) -> None:
    """Make an axis logarithmic if the ratio of its values exceeds ``_LOGARITHMIC``; None is no value."""
    known = [value for value in values if value is not None]
    if known and min(known) > 0 and max(known) / min(known) > _LOGARITHMIC:
        set_scale("log")


def save_figure(path: Path, figure: Figure, description: str | None = None) -> None:
    """Write the picture in the format of its suffix, and make its folder. description: kept in a PNG."""
    from matplotlib import pyplot

    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=110, metadata=None if description is None else {"Description": description})
    pyplot.close(figure)
