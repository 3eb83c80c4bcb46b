"""Rasterizers behind one interface, in a registry of lazy specs (entry points: ``beags.rasterizers``)."""

from __future__ import annotations

from beags_plugin.errors import UserError
from beags_plugin.rasterizers.interface import Rasterizer
from beags_plugin.registry import Registry

RASTERIZERS = Registry(
    "rasterizer",
    "beags.rasterizers",
    {
        "torch": "beags_plugin.rasterizers.torch_reference:TorchRasterizer",
        "native": "beags_plugin.rasterizers.native:NativeRasterizer",
        "cuda": "beags_plugin.rasterizers.cuda:CudaRasterizer",
    },
)
_PREFERENCE = ("native", "torch")  # what "auto" tries, best first


def make_rasterizer(name: str = "auto") -> Rasterizer:
    """The backend called ``name``; "auto" takes the best one present. Raises ``UserError`` if it cannot run here."""
    if name != "auto":
        backend = RASTERIZERS.get(name)
        if reason := backend.unavailable():
            raise UserError(f"the rasterizer {name!r} cannot run here: {reason}")
        return backend()
    for candidate in _PREFERENCE:
        backend = RASTERIZERS.get(candidate)
        if backend.unavailable() is None:
            return backend()
    raise UserError("no rasterizer can run here: reinstall beags.")
