"""A rasterizer that renders Gaussians on the device that holds them: a GPU or the CPU."""

from __future__ import annotations

from typing import Any

from beags_plugin.rasterizers.interface import Rasterizer, SurfelInputs
from beags_plugin.rasterizers.optional import OptionalProducts, optional_products


def _dispatched(name: str) -> Any:
    """Return a method that calls ``name`` of the backend for the device of its first argument."""

    def call(self: DeviceDispatchRasterizer, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Any:
        backend: Any = self.gpu if inputs.means.is_cuda else self.cpu
        if name in OptionalProducts.__abstractmethods__:
            backend = optional_products(backend)
        return getattr(backend, name)(inputs, *args, **kwargs)

    return call


class DeviceDispatchRasterizer(Rasterizer, OptionalProducts):
    """Hand every call of ``Rasterizer`` and ``OptionalProducts`` to one of two backends, by the surfels' device.

    cpu, gpu: the two backends, both of which can run.
    """

    def __init__(self, cpu: Rasterizer, gpu: Rasterizer) -> None:
        self.cpu, self.gpu = cpu, gpu

    @classmethod
    def unavailable(cls) -> str | None:
        return None

    rasterize = _dispatched("rasterize")
    class_contributions = _dispatched("class_contributions")
    sparse_class_contributions = _dispatched("sparse_class_contributions")
    sparse_class_pixel_counts = _dispatched("sparse_class_pixel_counts")
    sparse_top_contributions = _dispatched("sparse_top_contributions")
    class_map = _dispatched("class_map")
    class_channels = _dispatched("class_channels")
    feature_channels = _dispatched("feature_channels")
    dominant_gaussian = _dispatched("dominant_gaussian")
