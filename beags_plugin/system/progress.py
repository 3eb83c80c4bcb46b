"""Progress bars with the time left."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from time import monotonic, perf_counter
from typing import TypeVar

from rich import get_console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

A_MOMENT = 2.0  # seconds before a passing bar is shown

Item = TypeVar("Item")
Result = TypeVar("Result")
Bar = Callable[[str], AbstractContextManager[Callable[[int, int], None]]]
"""Shows a progress bar under a name, as ``progress_bar`` does."""


@contextmanager
def progress_bar(name: str, passing: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show a bar called ``name``; yields a callback that takes (done, total).

    passing: show the bar only once the work has taken ``A_MOMENT``, and remove it at the end.
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
            progress.start()  # does nothing if it is shown already

    if not passing:
        progress.start()
    try:
        yield update
    except BaseException:
        progress.live.transient = True  # the bar makes way for the error message
        raise
    finally:
        if progress.live.transient:
            progress.live.stop()  # progress.stop() would print a blank line where output is no terminal
        else:
            progress.stop()


@contextmanager
def timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    """Measure the wall time of the block into ``seconds[name]``."""
    start = perf_counter()
    yield
    seconds[name] = perf_counter() - start


def say(message: str, warning: bool = False) -> None:
    """Print a line as it is, above the bar if one is shown: on the console that bars use. warning: in yellow."""
    get_console().print(message, style="yellow" if warning else None, highlight=False, markup=False, soft_wrap=True)


def counted(items: Iterable[Item], total: int, progress: Callable[[int, int], None]) -> Iterator[Item]:
    """Yield the items; call ``progress`` with (done, total) when the next one is requested."""
    for done, item in enumerate(items, start=1):
        yield item
        progress(done, total)


def each_view(
    count: int, work: Callable[[int], Result], progress: Callable[[int, int], None] | None = None
) -> Iterator[Result]:
    """Yield ``work(0)``, .., ``work(count - 1)``, one after the other, as they are requested.

    progress: called with (done, count).
    """
    for index in range(count):
        result = work(index)
        if progress:
            progress(index + 1, count)
        yield result
