"""What a backend may compute besides: products that some refiners of other packages ask for, and no part of beags."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings, SurfelInputs
from beags_plugin.system.errors import UserError


class OptionalProducts(ABC):
    """A second base class of those backends that have these products; all use the weights w_i of ``rasterize``."""

    @abstractmethod
    def sparse_class_pixel_counts(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,  # [H, W] int32 class ids, or IGNORE
        num_classes: int,
        min_weight: float = 0.0,
    ) -> tuple[Tensor, Tensor]:
        """Return the numbers of pixels u with labels(u) = c and w_i(u) > min_weight that are not zero.

        They are keys [M] int64 as in ``Rasterizer.sparse_class_contributions``, and counts [M] int32. A hidden surfel
        counts too until compositing stops before it. No gradient.
        """

    @abstractmethod
    def sparse_top_contributions(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        labels: Tensor,  # [H, W] int32 class ids, or IGNORE
        num_classes: int,
        most: int,
        within: int,
    ) -> tuple[Tensor, Tensor]:
        """Return ``Rasterizer.sparse_class_contributions`` where of each pixel only the ``most`` largest w_i count.

        They are chosen, of equal ones the nearer, among the first ``within`` (at least 1, as ``most``) that the pixel
        has. No gradient.
        """

    @abstractmethod
    def class_channels(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> Tensor:
        """Return [H, W, num_classes], p_c = sum_i w_i [phi_i = c], differentiable in the inputs but their colours.

        A backend should take the same time for any number of classes if it can, as dL/dw_i is dL/dp at phi_i; else
        ``rendering.class_channels_by_threes`` does it.
        """


def optional_products(rasterizer: Rasterizer) -> OptionalProducts:
    """Return a backend as one that has the optional products; raises ``UserError`` if it has none."""
    if isinstance(rasterizer, OptionalProducts):
        return rasterizer
    raise UserError(
        f"the rasterizer {type(rasterizer).__name__} lacks products that this refiner needs: train with "
        "--pipeline.model.rasterizer native or torch."
    )
