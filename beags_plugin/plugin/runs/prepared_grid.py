"""grid.pt: the voxel grid that a run was prepared with."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors

_REMEDY = "restore it, or refine again from base/nerfstudio_models"


def read_grid(path: Path) -> VisibilityGrid | None:
    """The grid in a file that ``refinement.save_prepared`` wrote; None where the refiner needed none.

    Raises ``UserError`` if the file is damaged.
    """
    state = grid_state(path)
    return VisibilityGrid.from_state_dict(state) if state else None


def grid_state(path: Path, mmap: bool = False) -> dict[str, Any]:
    """The tensors of a grid, checked; empty without one. mmap: they stay in the file until they are used."""
    try:
        state = load_tensors(path, mmap=mmap)
    except (OSError, ValueError) as error:
        told = getattr(error, "strerror", None) or error
        raise UserError(f"the voxel grid {path} cannot be read ({told}): {_REMEDY}.") from error
    if part := _wrong_part(state):
        raise UserError(f"the voxel grid {path} is damaged ({part}): {_REMEDY}.")
    return state


def _wrong_part(state: Any) -> str | None:
    """What is wrong with the content of a grid; None for a good one, or none at all."""
    if not isinstance(state, dict):
        return "it is no table"
    if not state:
        return None
    for name in ("voxel_size", "origin", "num_classes", "keys", "classes"):
        if not isinstance(state.get(name), Tensor):
            return f"it has no {name}"
    size, origin, count = state["voxel_size"], state["origin"], state["num_classes"]
    if size.numel() != 1 or not size.is_floating_point() or not (math.isfinite(float(size)) and float(size) > 0):
        return "its voxel_size is no length"
    if origin.shape != (3,) or not origin.is_floating_point() or not bool(torch.isfinite(origin).all()):
        return "its origin is no point"
    if count.numel() != 1 or count.dtype not in (torch.int32, torch.int64) or not 1 <= int(count) <= 65_535:
        return "its num_classes is no number of classes"
    keys, classes = state["keys"], state["classes"]
    if keys.dim() != 1 or classes.shape != keys.shape or keys.dtype != torch.int64 or classes.dtype != torch.int32:
        return "its voxels and their classes do not fit together"
    if len(classes) and not 0 <= int(classes.min()) <= int(classes.max()) < 65_535:
        return "its classes are none"
    return None
