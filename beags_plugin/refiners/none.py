"""Assignment alone, as FlashSplat does it: the scene stays as it is."""

from __future__ import annotations

from beags_plugin.preparation.refiner import AssignedScene, Progress, Refiner


class NoRefiner(Refiner):
    """Leaves every parameter bit for bit as the base training left it."""

    @property
    def trains(self) -> bool:
        return False

    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> None:
        return None
