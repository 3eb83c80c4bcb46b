"""A rasterizer that renders on the GPU what lies there, and everything else on the CPU."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, SurfelInputs
from beags_plugin.rasterizers.optional import OptionalProducts, optional_products


class DeviceDispatchRasterizer(Rasterizer, OptionalProducts):
    """Hand every call of ``Rasterizer`` and ``OptionalProducts`` to one of two backends, by the surfels' device.

    cpu, gpu: the two backends, both of which can run.
    """

    def __init__(self, cpu: Rasterizer, gpu: Rasterizer) -> None:
        self.cpu, self.gpu = cpu, gpu

    @classmethod
    def unavailable(cls) -> str | None:
        return None

    def _backend(self, inputs: SurfelInputs) -> Rasterizer:
        return self.gpu if inputs.means.is_cuda else self.cpu

    def rasterize(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> RasterOutputs:
        return self._backend(inputs).rasterize(inputs, *args, **kwargs)

    def class_contributions(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Tensor:
        return self._backend(inputs).class_contributions(inputs, *args, **kwargs)

    def sparse_class_contributions(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        return self._backend(inputs).sparse_class_contributions(inputs, *args, **kwargs)

    def sparse_class_pixel_counts(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        return optional_products(self._backend(inputs)).sparse_class_pixel_counts(inputs, *args, **kwargs)

    def sparse_top_contributions(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        return optional_products(self._backend(inputs)).sparse_top_contributions(inputs, *args, **kwargs)

    def class_map(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        return self._backend(inputs).class_map(inputs, *args, **kwargs)

    def class_channels(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Tensor:
        return optional_products(self._backend(inputs)).class_channels(inputs, *args, **kwargs)

    def feature_channels(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Tensor | None:
        return self._backend(inputs).feature_channels(inputs, *args, **kwargs)

    def dominant_gaussian(self, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Tensor:
        return self._backend(inputs).dominant_gaussian(inputs, *args, **kwargs)
