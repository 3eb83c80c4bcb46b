"""The interface of losses: a name, a weight, the steps it is active in, and pure maths."""

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
    """Inputs of all losses in one training step; each uses what it needs.

    step: training step, from 0.
    seed: of the run; with the step it decides every random number.
    surfels: the scene, N surfels, with gradients.
    camera: the view that was rendered.
    render: the images, with what ``Loss.needs`` names.
    image: [H, W, 3] the photograph, in 0..1.
    labels: [H, W] int32 class ids M' of the view, or IGNORE; None if the view has none.
    class_ids: [N] int32, phi; None before assignment.
    grid: the visibility voxel grids; None before refinement.
    screen_shift: [N, 2] of the render's ``SurfelInputs``, whose gradient says where a base grows; None where none does.
    draw: renders other surfels than the render's, with geometry, on black; for losses that need a render of their own.
    members: the surfels of each class; present: ids of the objects in ``labels``, ascending. None where the host does
        not know them: a loss that needs them reads ``class_ids`` and ``labels``, for which a GPU must wait.
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
    """One term of the training loss; final classes add their own options as dataclass fields.

    weight: factor in the sum.
    start, stop: active at steps start <= step < stop; stop None means to the end.
    """

    needs: ClassVar[frozenset[str]] = frozenset()
    """What the rasterizer must supply: any of "geometry", "distortion", "boundary"."""

    weight: float = 1.0
    start: int = 0
    stop: int | None = None

    @property
    def asks_grid_about_background(self) -> bool:
        """Return whether it looks up the background's voxels; where no term does, the grid is made without them."""
        return False

    def active(self, step: int) -> bool:
        """Return whether the term counts at this step."""
        return self.weight != 0.0 and self.start <= step and (self.stop is None or step < self.stop)

    def weighted(self, inputs: LossInputs) -> Tensor:
        """Return the term as it enters the sum; compiled ops scale value and gradients at no cost."""
        value = self.value(inputs)
        return value if self.weight == 1.0 else self.weight * value

    @abstractmethod
    def value(self, inputs: LossInputs) -> Tensor:
        """Return the unweighted term: a scalar with gradients towards what it supervises."""
