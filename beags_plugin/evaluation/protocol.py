"""Choices of mask scoring on which papers differ, with their defaults (method, section 8)."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, get_args, get_type_hints

from beags_plugin.system.errors import UserError, check_choice


@dataclass(frozen=True)
class Protocol:
    """The choices behind a score; the defaults are the paper's where it states them."""

    threshold: float = 0.5
    """A pixel belongs to a mask where the alpha (extracted) or the rendered value (rendered) is greater."""
    resize: Literal["prediction", "truth"] = "prediction"
    """Which of the two masks is resized to the other's size, by nearest pixel."""
    scene_average: Literal["masks", "objects", "views"] = "masks"
    """Mean of a scene: over all its masks; or over the means of the objects; or over the means of the views."""
    data_set_average: Literal["scenes", "pooled"] = "scenes"
    """Mean of several scenes: over the means of the scenes; or as if all views were of one scene."""
    band_share: float = 0.02
    """Width of the boundary band, and margin outside of a mask before an object spills, as a share of the image
    diagonal; at least one pixel."""

    def check(self) -> None:
        """Raise ``UserError`` for a value that cannot be used."""
        if not 0.0 <= self.threshold < 1.0:
            raise UserError(f"threshold is {self.threshold}: give a number from 0 to below 1.")
        if not (math.isfinite(self.band_share) and self.band_share > 0.0):
            raise UserError(f"band_share is {self.band_share}: give a positive share of the diagonal, such as 0.02.")
        types = get_type_hints(Protocol)
        for field in fields(self):
            if choices := get_args(types[field.name]):
                check_choice(getattr(self, field.name), choices, "value", f" for {field.name}")
