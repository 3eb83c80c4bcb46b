"""What a refiner is: the part of an extraction method that comes after class assignment."""

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
    """A trained scene whose surfels have classes; the same input for every refiner, so that they can be compared.

    surfels: the base scene, N surfels, without gradients.
    class_ids: [N] int32, phi.
    cameras: the training views.
    labels: per training view [H, W] int32, the masks M' that all refiners are given.
    num_classes: ids lie below it, perhaps far apart: see ``labels.class_ranks`` before an array has an entry per class.
    depth: which depth stands for the surface: see ``rasterizers.rendering.surface_depth``.
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


@dataclass(frozen=True)
class EditedScene:
    """A scene of M surfels, some of them split before refinement, with classes of its own.

    edited: the surfels, for each the index [M] of the one that it came from, and whether it is new [M] bool.
    assignment: their classes.
    """

    edited: Densified
    assignment: Assignment


class Refiner(ABC):
    """One way to go on from assigned classes."""

    @property
    @abstractmethod
    def trains(self) -> bool:
        """Whether the scene's parameters are optimised after assignment; False leaves them bit for bit as they are."""

    @abstractmethod
    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> VisibilityGrid | None:
        """The visibility voxel grid that the refiner's losses need (``k`` as in E8), or None if they need none."""
