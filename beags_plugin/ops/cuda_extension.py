"""The CUDA part of the compiled module, if there is one, and what its fronts share."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from functools import cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import extension

_refused: list[str] = []  # the reason, if any, why this process does not use a module that is present


def refuse(reason: str) -> None:
    """Do not use the module from now on. reason: one sentence on why it does not work on this machine's GPU."""
    _refused[:] = [reason]


def status() -> tuple[ModuleType | None, str | None]:
    """Return ``beags_plugin._native.cuda``, or one sentence on why it cannot be used here."""
    return (None, _refused[0]) if _refused else present()


@cache
def present() -> tuple[ModuleType | None, str | None]:
    """Return what ``status`` would return had nothing been refused."""
    module, reason = extension.status()
    if module is None:
        return None, reason
    cuda = getattr(module, "cuda", None)
    if cuda is None:
        return (
            None,
            "beags was built without CUDA; install the CUDA toolkit (nvcc 12 or newer; docs/cuda.md: with pip) and "
            "reinstall beags.",
        )
    if not torch.cuda.is_available():
        return None, "torch finds no CUDA device; it needs an NVIDIA GPU, its driver, and a torch built for CUDA."
    driver, needed = cuda.driver_version(), cuda.needed_driver_version()
    if driver < needed:
        return None, (
            f"the GPU's driver supports CUDA up to {_dotted(driver)}, but beags was built with nvcc for "
            f"{_dotted(needed)} or newer; update the driver, or reinstall beags with an older nvcc (CUDACXX names one)."
        )
    return cuda, None


def _dotted(version: int) -> str:
    return f"{version // 1000}.{version % 1000 // 10}"


def load() -> ModuleType | None:
    """Return the module, or None where CUDA kernels cannot run."""
    return status()[0]


def module_for(*tensors: Tensor) -> ModuleType | None:
    """Return the module if it takes these float tensors (on one GPU, all float32 or all float64), else None."""
    first = tensors[0]
    if not first.is_cuda or first.dtype not in (torch.float32, torch.float64):
        return None
    if any(value.device != first.device or value.dtype != first.dtype for value in tensors):
        return None
    return load()


def supports(*tensors: Tensor) -> bool:
    """Return whether the compiled ops take these tensors: all float32 or all float64, on the CPU or on one GPU."""
    return extension.supports(*tensors) or module_for(*tensors) is not None


def stream(device: torch.device) -> int:
    """Return torch's current stream on ``device``; 0, the emulation's, for the CPU."""
    return torch.cuda.current_stream(device).cuda_stream if device.type == "cuda" else 0


def on_device(device: torch.device) -> AbstractContextManager:
    """Return a context in which ``device`` is torch's current GPU, as kernel launches need; empty for the CPU."""
    return torch.cuda.device(device) if device.type == "cuda" else nullcontext()


def call(module: ModuleType, name: str, like: Tensor, *arguments: Any) -> Any:
    """Call ``name`` of the module for the dtype and on the device of ``like``, with the stream as the last argument."""
    with on_device(like.device):
        return extension.function(name, like, module)(*arguments, stream(like.device))
