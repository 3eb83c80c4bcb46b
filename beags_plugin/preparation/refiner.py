"""The interface of refiners: the part of an extraction method after class assignment."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import Densified
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class AssignedScene:
    """A trained scene with classes, the common input of all refiners.

    surfels: the base scene, N Gaussians, without gradients. class_ids: [N] int32, phi.
    cameras: the training views. labels: per training view M', [H, W] int32.
    num_classes: ids lie below it, perhaps far apart: see ``labels.class_ranks`` for arrays with an entry per class.
    depth: the depth of the surface: see ``rasterizers.rendering.surface_depth``.
    unseen, votes: see ``PreparationConfig``.
    """

    surfels: Surfels
    class_ids: Tensor
    cameras: Sequence[Camera]
    labels: Sequence[Tensor]
    num_classes: int
    rasterizer: Rasterizer
    settings: RasterSettings
    seed: int
    depth: str = "median"
    unseen: bool = False
    votes: bool = False


@dataclass(frozen=True)
class EditedScene:
    """A scene of M Gaussians, some of them split before refinement, and their classes.

    edited: the Gaussians, of each the index [M] of its source and whether it is new [M] bool.
    """

    edited: Densified
    assignment: Assignment


class Refiner(ABC):
    """Interface of the refiners."""

    @property
    @abstractmethod
    def trains(self) -> bool:
        """Return whether the scene's parameters are optimised after assignment; False keeps them bit for bit."""

    @abstractmethod
    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> VisibilityGrid | None:
        """Build the visibility voxel grid of the refiner's losses (``k`` as in E8), or None if they need none."""
