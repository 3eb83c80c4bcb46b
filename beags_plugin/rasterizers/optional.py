"""Products that a backend may compute besides, for some refiners of other packages; beags itself needs none."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings, SurfelInputs
from beags_plugin.system.errors import UserError


class OptionalProducts(ABC):
    """The second base class of backends with these products; all use the weights w_i of ``rasterize``."""

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
        """Return the non-zero numbers of pixels u with labels(u) = c and w_i(u) > min_weight.

        Returns keys [M] int64 as in ``Rasterizer.sparse_class_contributions``, and counts [M] int32, without gradient.
        A hidden Gaussian counts too unless compositing stops before it.
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
        """Return ``Rasterizer.sparse_class_contributions`` of the ``most`` largest w_i of each pixel, without gradient.

        They are chosen among the first ``within`` hits of the pixel, the nearer of equals first. Both numbers are at
        least 1.
        """

    @abstractmethod
    def class_channels(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> Tensor:
        """Return [H, W, num_classes], p_c = sum_i w_i [phi_i = c], differentiable in the inputs except the colours.

        The time need not grow with the number of classes, because dL/dw_i is dL/dp at phi_i. A backend without such a
        kernel calls ``rendering.class_channels_by_threes``.
        """


def optional_products(rasterizer: Rasterizer) -> OptionalProducts:
    """Return the backend if it has the optional products; raises ``UserError`` if it has none."""
    if isinstance(rasterizer, OptionalProducts):
        return rasterizer
    raise UserError(
        f"the rasterizer {type(rasterizer).__name__} lacks products that this refiner needs: train with "
        "--pipeline.model.rasterizer native or torch."
    )
