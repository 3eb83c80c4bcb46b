"""The compiled module, if there is one, and the checks that all fronts share."""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module
from types import ModuleType

import torch  # must precede _native, which shares torch's OpenMP library
from torch import Tensor

from beags_plugin.system.errors import UserError

_SUFFIXES = {torch.float32: "f32", torch.float64: "f64"}


@cache
def status() -> tuple[ModuleType | None, str | None]:
    """Return ``beags_plugin._native``, or one sentence on why it is not there.

    Raises ``UserError`` if the instruction set that the environment requests cannot run: nothing may hide that.
    """
    if os.environ.get("BEAGS_NATIVE") == "0":
        return None, "BEAGS_NATIVE=0 in the environment turns the compiled module off; unset it."
    try:
        module = import_module("beags_plugin._native")
    except ModuleNotFoundError:
        return (
            None,
            "the compiled module beags_plugin._native was not built; install a C++ compiler and reinstall beags.",
        )
    except ImportError as error:
        return None, f"beags_plugin._native does not load ({error}); reinstall beags."
    try:
        module.instruction_set()
    except RuntimeError as error:
        raise UserError(str(error)) from None
    return module, None


def load() -> ModuleType | None:
    """Return ``beags_plugin._native``, or None where it was not built or does not load (``beags doctor`` says why)."""
    return status()[0]


def supports(*tensors: Tensor) -> bool:
    """Return whether the compiled ops are there and take these tensors: on the CPU, all float32 or all float64."""
    dtype = tensors[0].dtype
    for value in tensors:
        if not value.is_cpu or value.dtype != dtype:
            return False
    return dtype in _SUFFIXES and load() is not None


def module() -> ModuleType:
    """Return the compiled module for a caller that knows from ``load`` or ``supports`` that it is there."""
    compiled = load()
    assert compiled is not None, "the caller checks extension.load() first"
    return compiled


def function(name: str, like: Tensor, owner: object | None = None):
    """Return ``name`` of the compiled module (or of ``owner``, one of its objects) for the dtype of ``like``."""
    return getattr(module() if owner is None else owner, f"{name}_{_SUFFIXES[like.dtype]}")


def scaled(gradient: Tensor, factor: Tensor) -> Tensor:
    """Return ``gradient`` times the scalar ``factor``; itself, not a copy, where that is 1, as for most losses."""
    if factor.is_cuda:  # Reading the number would make the host wait.
        return gradient * factor
    return gradient if factor.item() == 1.0 else gradient * factor


def threads() -> int:
    """Return the number of threads that an op may use; no result depends on it."""
    return torch.get_num_threads()


def check(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    """Raise ``ValueError`` unless ``value`` has this shape and dtype."""
    if value.shape != shape or value.dtype != dtype:
        raise ValueError(f"{name} must be {list(shape)} {dtype}, not {list(value.shape)} {value.dtype}")


def plain(name: str, value: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return ``value``, contiguous and without gradient; raise ``ValueError`` unless it has this shape and dtype."""
    check(name, value, shape, dtype)
    return value.detach().contiguous()
