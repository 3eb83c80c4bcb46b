"""The CUDA backend as tests see it: on a GPU where there is one, and its kernels in an emulation on the CPU."""

from __future__ import annotations

from dataclasses import fields, replace
from importlib import import_module
from types import ModuleType

import pytest
import torch
from torch import Tensor

from beags_plugin.ops import cuda_extension
from beags_plugin.rasterizers.cuda import CudaRasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, SurfelInputs
from beags_plugin.rasterizers.optional import OptionalProducts


def emulation() -> ModuleType | None:
    """Return ``beags_plugin._cuda_emulation``: the kernels' sources, run on the CPU; None where it was not built."""
    try:
        return import_module("beags_plugin._cuda_emulation")
    except ImportError:
        return None


def cuda_device(request, monkeypatch) -> torch.device:
    """Return the device of the CUDA ops' tensors, as a fixture's body: a GPU, or for the emulation the CPU.

    ``request.param``: "cuda" or "cuda emulated".
    """
    if request.param == "cuda":
        if reason := cuda_extension.status()[1]:
            pytest.skip(reason)
        return torch.device("cuda")
    module = emulation()
    if module is None:
        pytest.skip("beags_plugin._cuda_emulation was not built (BEAGS_CUDA_EMULATION=ON)")
    monkeypatch.setattr(cuda_extension, "module_for", lambda *tensors: module)
    monkeypatch.setattr(cuda_extension, "load", lambda: module)
    return torch.device("cpu")


class EmulatedCudaRasterizer(CudaRasterizer):
    """The CUDA rasterizer's front and kernels, on CPU tensors."""

    def __init__(self) -> None:
        super().__init__()
        self._module = emulation()

    @classmethod
    def unavailable(cls) -> str | None:
        return None if emulation() else "beags_plugin._cuda_emulation was not built (BEAGS_CUDA_EMULATION=ON)"


class CudaOnCpuTensors(Rasterizer, OptionalProducts):
    """The CUDA rasterizer behind CPU tensors, so that the bodies of all tests run on it as they are."""

    def __init__(self) -> None:
        self.cuda = CudaRasterizer()

    @classmethod
    def unavailable(cls) -> str | None:
        return CudaRasterizer.unavailable()

    def rasterize(self, inputs, camera, settings, background, target=None):
        there = None if target is None else target.cuda()
        inputs = inputs.checked()
        drawn = self.cuda.rasterize(_to_gpu(inputs), camera, settings, background.cuda(), there)
        values = {field.name: getattr(drawn, field.name) for field in fields(RasterOutputs)}
        return replace(drawn, **{name: value.cpu() for name, value in values.items() if isinstance(value, Tensor)})

    def class_contributions(self, inputs, camera, settings, labels, num_classes):
        return self.cuda.class_contributions(_to_gpu(inputs), camera, settings, labels.cuda(), num_classes).cpu()

    def sparse_class_pixel_counts(self, inputs, camera, settings, labels, num_classes, min_weight=0.0):
        what = (_to_gpu(inputs), camera, settings, labels.cuda(), num_classes, min_weight)
        keys, counts = self.cuda.sparse_class_pixel_counts(*what)
        return keys.cpu(), counts.cpu()

    def sparse_top_contributions(self, inputs, camera, settings, labels, num_classes, most, within):
        what = (_to_gpu(inputs), camera, settings, labels.cuda(), num_classes, most, within)
        keys, sums = self.cuda.sparse_top_contributions(*what)
        return keys.cpu(), sums.cpu()

    def class_map(self, inputs, camera, settings, num_classes):
        classes, share = self.cuda.class_map(_to_gpu(inputs), camera, settings, num_classes)
        return classes.cpu(), share.cpu()

    def class_channels(self, inputs, camera, settings, num_classes):
        return self.cuda.class_channels(_to_gpu(inputs), camera, settings, num_classes).cpu()

    def dominant_gaussian(self, inputs, camera, settings):
        return self.cuda.dominant_gaussian(_to_gpu(inputs), camera, settings).cpu()


def _to_gpu(inputs: SurfelInputs) -> SurfelInputs:
    values = {field.name: getattr(inputs, field.name) for field in fields(SurfelInputs)}
    return SurfelInputs(**{name: None if value is None else value.cuda() for name, value in values.items()})


BACKENDS: dict[str, type[Rasterizer]] = {"cuda": CudaOnCpuTensors, "cuda emulated": EmulatedCudaRasterizer}
