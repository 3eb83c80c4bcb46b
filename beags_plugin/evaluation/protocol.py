"""Choices of mask scoring on which papers differ, with their defaults (method, section 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class Protocol:
    """The choices behind a score; the defaults are the paper's where it states them."""

    threshold: float = 0.5
    """A pixel belongs to a mask where the alpha (extracted) or the rendered value (rendered) is greater."""
    band_share: float = 0.02
    """Width of the boundary band, and margin outside of a mask before an object spills, as a share of the image
    diagonal; at least one pixel."""

    def check(self) -> None:
        """Raise ``UserError`` for a value that cannot be used."""
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold}: give a number from 0 to below 1.")
        if not (math.isfinite(self.band_share) and self.band_share > 0.0):
            raise UserError(f"band_share is {self.band_share}: give a positive share of the diagonal, such as 0.02.")
