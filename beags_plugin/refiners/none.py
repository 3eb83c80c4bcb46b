"""Assignment alone: each Gaussian in the class to which it contributes most (E6)."""

from __future__ import annotations

from dataclasses import dataclass

from beags_plugin.preparation.refiner import Refiner


@dataclass(frozen=True)
class NoRefiner(Refiner):
    """Keeps every parameter of the base bit for bit."""
