"""A term of the training loss as configs list it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from tyro.conf import Suppress

Phase = Literal["base", "refine", "both"]


@dataclass
class LossSpec:
    """One term of the training loss, as a config lists it; presets alone set ``phase`` and ``start``."""

    weight: float = 1.0
    """Factor of the term in the sum; 0 switches it off."""
    phase: Suppress[Phase] = "both"
    """Phase in which the term may act."""
    start: Suppress[int] = 0
    """First step of the term: a step of the run, stated for a base of schedule_steps; with phase "refine", a step of
    the refinement, which is never scaled."""
    options: dict[str, bool | int | float] = field(default_factory=dict)
    """Options of the loss itself. occupancy: samples, points per Gaussian and step (Z); background, the share of the
    weight on the background's Gaussians, 1 as in the paper. silhouette: objects, the number rendered in each step;
    seen, the number of the 27 voxels around a pixel of another object that, seen as the object's own, exempt it; 0:
    never."""
