"""The result of one check of the doctor, and the table of all of them."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    name: what. ok: whether it is there. sentence: what was found, or what to do. required: whether beags cannot
    run without it. repair: the one command that mends it, or "" where it is there or no command does.
    """

    name: str
    ok: bool
    sentence: str
    required: bool = True
    repair: str = ""

    def to_json(self) -> dict[str, object]:
        """Plain values by name."""
        return asdict(self)


def first_line(error: BaseException) -> str:
    """Return the kind of an error and the first line of its message."""
    text = str(error).strip()
    return f"{type(error).__name__}: {text.splitlines()[0]}" if text else type(error).__name__


def print_report(checks: list[Check], console: Console | None = None) -> None:
    """Print the checks as a table: "ok", "missing" (beags cannot run) or "absent" (something optional).

    Below what does not work stands the one command that repairs it.
    """
    from rich.console import Console
    from rich.table import Column, Table
    from rich.text import Text

    table = Table("", "", Column(overflow="fold"), show_header=False, box=None, padding=(0, 1))
    for check in checks:
        word, style = ("ok", "green") if check.ok else ("missing", "red") if check.required else ("absent", "yellow")
        table.add_row(Text(word, style=style), Text(check.name), Text(check.sentence))
        if check.repair:
            table.add_row("", "", Text(f"repair: {check.repair}", style="bold"))
    (console or Console()).print(table)
