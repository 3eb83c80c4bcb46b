"""What a check found: which file, what is wrong, what to do, and what it costs to leave it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")
STOPS = "training stops when it reads this file"


@dataclass(frozen=True)
class Issue:
    """One thing that is wrong with the masks, or may be.

    level: "error": training refuses it; "warning": it costs quality; "note": fine if it is meant.
    kind: the same short word for all issues alike. message: which file or object, what is wrong, what to do.
    cost: what it costs to leave it, with figures. views: stems of the images that it is about.
    """

    level: Level
    kind: str
    message: str
    cost: str
    views: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "views": list(self.views)}


def ordered(issues: Sequence[Issue]) -> list[Issue]:
    """Errors first, then warnings, then notes; alike ones stay in their order."""
    return sorted(issues, key=lambda issue: (LEVELS.index(issue.level), issue.kind))


def named(items: Sequence[object], most: int = 5) -> str:
    """The first few of many in words, and how many more there are."""
    shown = ", ".join(str(item) for item in items[:most])
    return shown if len(items) <= most else f"{shown} and {len(items) - most} more"


def percent(part: float, whole: float) -> str:
    """A share in percent with as many digits as tell something."""
    share = 100.0 * part / whole if whole else 0.0
    return f"{share:.0f} %" if share >= 10 else f"{share:.2g} %"
