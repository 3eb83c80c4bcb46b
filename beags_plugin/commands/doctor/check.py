"""Results of the doctor's checks, and their table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Check:
    """The result of one check.

    name: of the part. ok: whether it exists and works. sentence: the result, or advice. required: whether beags cannot
    run without it. repair: the one command that repairs it; "" if it works or no command repairs it.
    """

    name: str
    ok: bool
    sentence: str
    required: bool = True
    repair: str = ""


def first_line(error: BaseException) -> str:
    """Return the kind of an error and the first line of its message."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def print_check(check: Check, console: Console | None = None) -> None:
    """Print a check as "ok", "missing" (beags cannot run) or "absent" (optional), with the repair below."""
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    table = Table(
        Column(width=7), Column(width=18), Column(overflow="fold"), show_header=False, box=None, padding=(0, 1)
    )
    word, style = ("ok", "green") if check.ok else ("missing", "red") if check.required else ("absent", "yellow")
    table.add_row(Text(word, style=style), Text(check.name), Text(check.sentence))
    if check.repair:
        table.add_row("", "", Text(f"repair: {check.repair}", style="bold"))
    (console or Console()).print(table)
