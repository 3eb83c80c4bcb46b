"""Assignment alone: each Gaussian belongs to the class of its largest share (argmax); nothing is trained."""

from __future__ import annotations

from beags_plugin.preparation.refiner import AssignedScene, Progress, Refiner


class NoRefiner(Refiner):
    """Keeps every parameter of the base bit for bit."""

    @property
    def trains(self) -> bool:
        return False

    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> None:
        return None
