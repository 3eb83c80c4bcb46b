"""``beags bench sample``: a generated scene whose photos differ, or whose masks share errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from beags_plugin.commands.cli import Sample

if TYPE_CHECKING:
    from beags_benchmarks.samples.config import VariedSample


@dataclass
class BenchSample(Sample):
    """Generate a scene as beags sample does, with photos that differ or masks that share errors."""

    degradation: str = "mild"
    """How masks are damaged: none, mild or strong, or any degree from 0 on (1 is mild, 2 strong)."""
    exposure: float = 0.0
    """The largest difference of a photo's exposure from the mean, in stops (EV), at most 6."""
    white_balance: float = 0.0
    """The largest difference of a photo's red from the mean, and of its blue the other way, in stops, at most 6."""
    moved: int = 0
    """Views to train on that show something of the background which stands elsewhere in each, and in no other view."""
    shared_damage: float = 0.0
    """Share of the masks to train on, 0 to 1, in which half of the objects take in what they stand on, or lack a foot,
    alike in all of them."""

    def config(self) -> VariedSample:
        from beags_benchmarks.samples.config import VariedSample

        own = {name: getattr(self, name) for name in ("exposure", "white_balance", "moved", "shared_damage")}
        return VariedSample(**vars(super().config()), **own)
