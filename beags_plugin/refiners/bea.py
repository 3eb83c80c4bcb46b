"""BEA-GS: refine with the 2D boundary loss and the 3D occupancy loss (paper sections 3.3 and 3.4)."""

from __future__ import annotations

from dataclasses import dataclass

from beags_plugin.occupancy.build import build_visibility_grid
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.preparation.refiner import AssignedScene, Progress, Refiner


@dataclass(frozen=True)
class BeaRefiner(Refiner):
    """Trains the scene with the losses of the refinement phase; classes and number of Gaussians stay fixed."""

    @property
    def trains(self) -> bool:
        return True

    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> VisibilityGrid:
        return build_visibility_grid(
            scene.surfels,
            scene.class_ids,
            scene.cameras,
            scene.rasterizer,
            scene.settings,
            scene.num_classes,
            k=k,
            seed=scene.seed,
            depth=scene.depth,
            progress=progress,
        )
