"""A progress bar with the time left, for every stage that takes longer than a moment."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

A_MOMENT = 2.0  # seconds

Item = TypeVar("Item")


@contextmanager
def progress_bar(name: str, passing: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Draw a bar called ``name``; the callback that it yields takes (done, total).

    passing: for what happens often, and mostly takes no time: draw it only after a moment, and remove it at the end.
    """
    columns = (
        TextColumn("  {task.description:<22}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns, transient=passing)
    task, began = progress.add_task(name, total=None), monotonic()

    def update(done: int, total: int) -> None:
        progress.update(task, completed=done, total=total)
        if passing and monotonic() - began > A_MOMENT:
            progress.start()  # nothing, if it is drawn already

    if not passing:
        progress.start()
    try:
        yield update
    except BaseException:
        progress.live.transient = True  # what stopped it says more than half a bar
        raise
    finally:
        if progress.live.transient:
            progress.live.stop()  # progress.stop() would print a blank line where output is no terminal
        else:
            progress.stop()


def counted(items: Iterable[Item], total: int, progress: Callable[[int, int], None]) -> Iterator[Item]:
    """The items, one by one; progress: is told (done, total) when the next one is asked for."""
    for done, item in enumerate(items, start=1):
        yield item
        progress(done, total)
