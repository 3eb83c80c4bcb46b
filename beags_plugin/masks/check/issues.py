"""Issues that a check of masks reports: the mistake, the remedy, and the cost of leaving it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Level = Literal["error", "warning", "note"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note")
STOPS = "training stops when it reads this file"


@dataclass(frozen=True)
class Issue:
    """A mistake in the masks, or a possible one.

    level: "error", training refuses it; "warning", it costs quality; "note", fine if intended. kind: a short name that
    similar issues share. message: file or object, mistake, remedy. cost: what the mistake costs, with figures. views:
    stems of the images concerned. objects: class ids concerned.
    """

    level: Level
    kind: str
    message: str
    cost: str
    views: tuple[str, ...] = ()
    objects: tuple[int, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "views": list(self.views), "objects": list(self.objects)}


def ordered(issues: Sequence[Issue]) -> list[Issue]:
    """Sort errors first, then warnings, then notes; by kind within a level."""
    return sorted(issues, key=lambda issue: (LEVELS.index(issue.level), issue.kind))


def named(items: Sequence[object], most: int = 5) -> str:
    """Return the first ``most`` items as a list in words, and the number of the others."""
    listed = ", ".join(str(item) for item in items[:most])
    return listed if len(items) <= most else f"{listed} and {len(items) - most} more"


def percent(part: float, whole: float) -> str:
    """Format a share in percent, with two digits below 10 %."""
    share = 100.0 * part / whole if whole else 0.0
    return f"{share:.0f} %" if share >= 10 else f"{share:.2g} %"
