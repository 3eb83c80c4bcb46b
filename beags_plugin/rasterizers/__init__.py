"""Rasterizers behind one interface, in a registry of lazy specs (entry points: ``beags.rasterizers``)."""

from __future__ import annotations

from typing import Any

from beags_plugin.rasterizers import first_contact
from beags_plugin.rasterizers.interface import Rasterizer, SurfelInputs
from beags_plugin.rasterizers.optional import OptionalProducts, optional_products
from beags_plugin.system.errors import UserError
from beags_plugin.system.registry import Registry

RASTERIZERS = Registry(
    "rasterizer",
    "beags.rasterizers",
    {
        "torch": "beags_plugin.rasterizers.torch_reference:TorchRasterizer",
        "native": "beags_plugin.rasterizers.native:NativeRasterizer",
        "cuda": "beags_plugin.rasterizers.cuda:CudaRasterizer",
    },
)
_PREFERENCE = ("native", "torch")  # backends that "auto" tries, best first; on a GPU "cuda" comes before them


def make_rasterizer(name: str = "auto") -> Rasterizer:
    """Return the backend called ``name``; raises ``UserError`` if it cannot run here.

    "auto" uses the best backend for the CPU. Where there is a GPU, its tensors go to the CUDA backend, or, if that
    cannot run or has failed its trial (``first_contact``), to the torch backend, because nerfstudio's commands load a
    run onto any GPU.
    """
    if name != "auto":
        backend = RASTERIZERS.get(name)
        if reason := backend.unavailable():
            raise UserError(f"the rasterizer {name!r} cannot run here: {reason}")
        return backend()
    for candidate in _PREFERENCE:
        backend = RASTERIZERS.get(candidate)
        if backend.unavailable() is None:
            on_gpu = RASTERIZERS.get("cuda")
            if on_gpu.unavailable() is None:
                first_contact.settle()  # The backend becomes unavailable if it fails its trial.
            if on_gpu.unavailable() is not None:
                import torch

                if not torch.cuda.is_available():
                    return backend()
                on_gpu = RASTERIZERS.get("torch")
            return DeviceDispatchRasterizer(backend(), on_gpu())
    raise UserError("no rasterizer can run here: reinstall beags.")


def _dispatched(name: str) -> Any:
    """Return a method that calls ``name`` of the backend for the device of its first argument."""

    def call(self: DeviceDispatchRasterizer, inputs: SurfelInputs, *args: Any, **kwargs: Any) -> Any:
        backend: Any = self.gpu if inputs.means.is_cuda else self.cpu
        if name in OptionalProducts.__abstractmethods__:
            backend = optional_products(backend)
        return getattr(backend, name)(inputs, *args, **kwargs)

    return call


class DeviceDispatchRasterizer(Rasterizer, OptionalProducts):
    """Hand every call of ``Rasterizer`` and ``OptionalProducts`` to one of two backends, by the Gaussians' device.

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
