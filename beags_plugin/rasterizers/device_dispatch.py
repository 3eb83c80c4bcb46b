"""A rasterizer that draws on the GPU what lies there, and everything else on the CPU."""

from __future__ import annotations

from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings, SurfelInputs


class DeviceDispatchRasterizer(Rasterizer):
    """Hands every call to one of two backends, by the device of the surfels.

    cpu, gpu: the two.
    """

    def __init__(self, cpu: Rasterizer, gpu: Rasterizer) -> None:
        self.cpu, self.gpu = cpu, gpu

    @classmethod
    def unavailable(cls) -> str | None:
        """See ``Rasterizer.unavailable``: it is made of backends that can run."""
        return None

    def _backend(self, inputs: SurfelInputs) -> Rasterizer:
        return self.gpu if inputs.means.is_cuda else self.cpu

    def rasterize(
        self,
        inputs: SurfelInputs,
        camera: Camera,
        settings: RasterSettings,
        background: Tensor,
        target: Tensor | None = None,
    ) -> RasterOutputs:
        """See ``Rasterizer.rasterize``."""
        return self._backend(inputs).rasterize(inputs, camera, settings, background, target)

    def class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> Tensor:
        """See ``Rasterizer.class_contributions``."""
        return self._backend(inputs).class_contributions(inputs, camera, settings, labels, num_classes)

    def sparse_class_contributions(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, labels: Tensor, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """See ``Rasterizer.sparse_class_contributions``."""
        return self._backend(inputs).sparse_class_contributions(inputs, camera, settings, labels, num_classes)

    def class_map(
        self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings, num_classes: int
    ) -> tuple[Tensor, Tensor]:
        """See ``Rasterizer.class_map``."""
        return self._backend(inputs).class_map(inputs, camera, settings, num_classes)

    def dominant_gaussian(self, inputs: SurfelInputs, camera: Camera, settings: RasterSettings) -> Tensor:
        """See ``Rasterizer.dominant_gaussian``."""
        return self._backend(inputs).dominant_gaussian(inputs, camera, settings)
