"""The interface of refiners: the part of an extraction method after class assignment."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

from torch import Tensor

from beags_plugin.assignment.contributions import Contributions
from beags_plugin.core.cameras import Camera
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.preparation.refiner_training import OwnTraining, Stage, TrainedScene
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class AssignedScene:
    """A trained scene with classes, the common input of all refiners.

    surfels: the base scene, N Gaussians, without gradients. class_ids: [N] int32, phi.
    cameras: the training views. labels: per training view M', [H, W] int32.
    num_classes: ids lie below it, perhaps far apart: see ``labels.class_ranks`` for arrays with an entry per class.
    objects: their ids, ascending, without the background.
    contributions: C of E6, in the base. scale: units of the run's frame per unit of the input poses'.
    depth: kind of the surface depth: see ``rasterizers.rendering.surface_depth``.
    stage: opens a progress bar with a title.
    """

    surfels: Surfels
    class_ids: Tensor
    cameras: Sequence[Camera]
    labels: Sequence[Tensor]
    num_classes: int
    objects: Sequence[int]
    rasterizer: Rasterizer
    settings: RasterSettings
    seed: int
    contributions: Contributions
    scale: float = 1.0
    depth: str = "median"
    stage: Stage = lambda title: nullcontext()


@dataclass(frozen=True)
class Refiner:
    """Interface of the refiners: frozen dataclasses, whose fields, all with defaults, are their options.

    This class itself trains nothing: it leaves the base with its assigned classes.
    """

    @property
    def trains(self) -> bool:
        """Return whether refinement trains the scene with the losses of the config."""
        return False

    @property
    def leaves_base(self) -> bool:
        """Return whether every parameter stays as it is in the base."""
        return not self.trains and type(self).own_training is Refiner.own_training

    @property
    def joins_base(self) -> bool:
        """Return whether ``own_training`` makes the steps of the base too, from ``seed_classes`` on."""
        return False

    def check(self, names: Mapping[int, str]) -> None:
        """Raise ``UserError`` for options that do not fit the classes; names: by id, background (0) included."""
        return None

    def steps(self, requested: int, views: int, objects: int) -> int:
        """Return the number of steps of refinement.

        requested: the option ``refine_steps``. views: number of training views. objects: number of classes but the
        background.
        """
        return requested if self.trains else 1  # This one step changes nothing.

    def build_grid(self, scene: AssignedScene, k: int, progress: Progress | None = None) -> VisibilityGrid | None:
        """Build the visibility voxel grid of the refiner's losses (``k`` as in E8), or None if they need none."""
        return None

    def members(self, scene: AssignedScene) -> Membership | None:
        """Return which Gaussians belong to which object before any step; None: their classes phi decide."""
        return None

    def seed_classes(self, scene: TrainedScene) -> Tensor:
        """Return the classes [N] int32 at the start of a base that it joins; new Gaussians inherit them."""
        raise NotImplementedError

    def own_training(self, scene: TrainedScene) -> OwnTraining | None:
        """Return the training of a refiner that makes its steps itself; None for the others."""
        return None
