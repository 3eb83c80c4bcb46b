"""The plan of an experiment for a terminal: its trials and the hours, memory and disk that they need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from beags_benchmarks.experiments.forecast import SceneForecast
from beags_benchmarks.experiments.report import number, plain_table

if TYPE_CHECKING:
    from rich.table import Table

_MISSING = "–"
_MOST_KINDS = 6  # kinds named in a line


def plan_table(forecasts: Sequence[SceneForecast]) -> Table:
    """Return the trials of each scene and their needs; a dash if no trial of the kind has finished."""
    rows = []
    for each in forecasts:
        known = each.trials - each.done > 0 and not each.unknown
        spent = each.trials == each.done
        rows.append(
            [
                each.title,
                str(each.trials),
                str(each.done),
                str(each.size.views),
                number(each.size.pixels / 1e6, 1),
                number(each.hours, 2) if known or spent else _MISSING,
                number(each.memory_mb, 0) if known else _MISSING,
                number(each.disk_mb / 1e3, 2) if known or spent else _MISSING,
                number(each.temporary_mb / 1e3, 2),
            ]
        )
    heads = ("scene", "trials", "done", "views", "10^6\npixels", "hours", "memory\nMB", "disk\nGB", "of it\ntemporary")
    return plain_table("Trials and what is left of them", heads, rows)


def plan_lines(forecasts: Sequence[SceneForecast], smallest: str) -> list[str]:
    """Return sentences with the sums over all scenes and the kinds of trials without a forecast.

    smallest: the option with which one trial of each kind finishes soon.
    """
    to_do = sum(each.trials - each.done for each in forecasts)
    lines = [f"{sum(each.trials for each in forecasts)} trials, {to_do} of them not done."]
    if unknown := list(dict.fromkeys(kind for each in forecasts for kind in each.unknown)):
        more = len(unknown) - _MOST_KINDS
        names = ", ".join(unknown[:_MOST_KINDS]) + (f" and {more} more" if more > 0 else "")
        lines.append(
            f"Hours, memory and disk of {names} are known once one of each has finished here ({smallest}); they are "
            "then scaled by the training pixels."
        )
    elif to_do:
        hours, disk = sum(each.hours for each in forecasts), sum(each.disk_mb - each.temporary_mb for each in forecasts)
        memory = max(each.memory_mb for each in forecasts)
        lines.append(
            f"Some {hours:.2f} hours, {memory:.0f} MB of memory and {disk / 1e3:.2f} GB of disk, by the finished "
            "trials of each kind, scaled by the training pixels (memory: the largest so far). The hours are of one "
            "trial after the other."
        )
    return lines
