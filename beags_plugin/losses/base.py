"""The interface of a loss: its weight, the steps in which it is active, and a pure function of ``LossInputs``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import RasterOutputs, SurfelInputs

if TYPE_CHECKING:
    from beags_plugin.losses.class_members import ClassMembers
    from beags_plugin.occupancy.grid import VisibilityGrid


@dataclass(frozen=True)
class LossInputs:
    """The inputs of all losses in one training step; each loss reads what it needs. Floats are float32 in training.

    step: training step, from 0.
    seed: seed of the run; with the step it decides every random number.
    surfels: the scene's N Gaussians, with gradients.
    camera: the view that was rendered.
    render: the rendered images, with what ``Loss.needs`` names.
    image: [H, W, 3] the photo, in 0..1.
    labels: [H, W] int32 class ids M' of the view, or IGNORE; None if the view has no mask.
    class_ids: [N] int32, phi; None before assignment.
    grid: the visibility voxel grids; None before refinement.
    screen_shift: [N, 2], as in the render's ``SurfelInputs``; its gradient decides where the base grows. None
        while nothing grows.
    draw: renders any Gaussians with geometry, on black; for losses that need a render besides ``render``.
    members: the Gaussians of each class. With None a loss sorts ``class_ids`` itself, and waits for the GPU.
    present: ids of the objects in ``labels``, ascending. With None a loss reads them from ``labels``, and waits too.
    """

    step: int
    seed: int
    surfels: Surfels
    camera: Camera
    render: RasterOutputs
    image: Tensor
    labels: Tensor | None = None
    class_ids: Tensor | None = None
    grid: VisibilityGrid | None = None
    screen_shift: Tensor | None = None
    draw: Callable[[SurfelInputs, Camera], RasterOutputs] | None = None
    members: ClassMembers | None = None
    present: Sequence[int] | None = None


@dataclass(frozen=True)
class Loss(ABC):
    """One term of the training loss; a subclass adds its options as dataclass fields.

    weight: factor of the term in the sum.
    start, stop: the term is active at steps start <= step < stop; stop None means the end of training.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    """Images that the rasterizer must render for the loss: any of "geometry", "distortion", "boundary"."""

    weight: float = 1.0
    start: int = 0
    stop: int | None = None

    @property
    def asks_grid_about_background(self) -> bool:
        """Return whether the term looks up voxels of the background; if none does, the grid has no such voxels."""
        return False

    def active(self, step: int) -> bool:
        """Return whether the term counts at this step."""
        return self.weight != 0.0 and self.start <= step and (self.stop is None or step < self.stop)

    def weighted(self, inputs: LossInputs) -> Tensor:
        """Return the term times its weight, a scalar; compiled ops apply the weight themselves, at no cost."""
        value = self.value(inputs)
        return value if self.weight == 1.0 else self.weight * value

    @abstractmethod
    def value(self, inputs: LossInputs) -> Tensor:
        """Return the unweighted term: a scalar, with gradients to the parameters that it supervises."""
