"""Options of the splat formats, as command lines have them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class SplatOptions:
    """What splat files hold."""

    spz_version: Literal[3, 4] = 3
    """Version of .spz: 3, which most readers know, or 4, a little smaller."""

    def of_formats(self) -> dict[str, dict[str, Any]]:
        """Return the options of exporters by their names."""
        return {"spz": {"version": self.spz_version}}
