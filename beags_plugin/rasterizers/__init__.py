"""Rasterizers behind one interface, in a registry of lazy specs (entry points: ``beags.rasterizers``)."""

from __future__ import annotations

from beags_plugin.rasterizers import first_contact
from beags_plugin.rasterizers.interface import Rasterizer
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
            from beags_plugin.rasterizers.device_dispatch import DeviceDispatchRasterizer

            return DeviceDispatchRasterizer(backend(), on_gpu())
    raise UserError("no rasterizer can run here: reinstall beags.")
