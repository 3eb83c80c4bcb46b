"""Checkpoint files: read, and checked before anything is made of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors

_WIDTHS = {"means": (3,), "quats": (4,), "scales": (2,), "opacities": (1,), "features_dc": (3,)}
_FLOATS = [*(f"gauss_params.{name}" for name in (*_WIDTHS, "features_rest")), "class_margin", "extent"]


def read_checkpoint(path: Path) -> dict[str, Any]:
    """All that a checkpoint holds, on the CPU; raises ``UserError`` for a file that is none."""
    try:
        checkpoint = load_tensors(path)
    except FileNotFoundError:
        raise UserError(f"there is no checkpoint {path}: name one of an earlier run.") from None
    except ValueError as error:
        raise UserError(f"the checkpoint {path} is damaged ({error}): name an earlier one.") from error
    if not isinstance(checkpoint, dict) or not {"step", "pipeline", "optimizers", "scalers"} <= set(checkpoint):
        raise UserError(f"{path} is no checkpoint of ns-train: name a step-….ckpt of a run.")
    if not isinstance(checkpoint["pipeline"], dict) or type(checkpoint["step"]) is not int:
        raise UserError(f"{path} is no checkpoint of ns-train: name a step-….ckpt of a run.")
    return checkpoint


def scene_alone(checkpoint: dict[str, Any]) -> bool:
    """Whether the checkpoint has no state to train on from: ``<run>/base`` and extracted runs are such."""
    return not checkpoint["optimizers"]


def check_state(state: Mapping[str, Any], path: Path) -> None:
    """Raise ``UserError`` unless ``state`` is that of a ``BeagsModel`` with classes. path: where it is from."""
    if wrong := _wrong(state):
        raise UserError(f"the checkpoint {path} holds no scene of beags ({wrong}): name another, or train again.")


def _wrong(state: Mapping[str, Any]) -> str | None:
    means = state.get("gauss_params.means")
    count = len(means) if isinstance(means, Tensor) and means.dim() == 2 else -1
    for name, width in _WIDTHS.items():
        if wrong := _wrong_shape(state, f"gauss_params.{name}", (count, *width)):
            return wrong
    for name in ("class_ids", "class_margin"):
        if wrong := _wrong_shape(state, name, (count,)):
            return wrong
    for name in ("assigned", "extent"):
        if wrong := _wrong_shape(state, name, ()):
            return wrong
    rest = state.get("gauss_params.features_rest")
    if not isinstance(rest, Tensor) or rest.dim() != 3 or (len(rest), *rest.shape[2:]) != (count, 3):
        return "gauss_params.features_rest is missing or of another shape"
    if wrong := next((name for name in _FLOATS if not state[name].is_floating_point()), None):
        return f"{wrong} holds {state[wrong].dtype}"
    if rest.shape[1] not in (0, 3, 8, 15):
        return f"gauss_params.features_rest has {rest.shape[1]} colour bands"
    if not (bool(torch.isfinite(state["extent"])) and float(state["extent"]) > 0):
        return f"extent is {float(state['extent'])}"
    return _wrong_classes(state)


def _wrong_shape(state: Mapping[str, Any], name: str, shape: tuple[int, ...]) -> str | None:
    value = state.get(name)
    if not isinstance(value, Tensor):
        return f"{name} is missing"
    return None if tuple(value.shape) == shape else f"{name} is {list(value.shape)}, not {list(shape)}"


def _wrong_classes(state: Mapping[str, Any]) -> str | None:
    extra = state.get("_extra_state")
    names = extra.get("classes") if isinstance(extra, dict) else None
    if not isinstance(names, dict) or not all(type(i) is int and isinstance(name, str) for i, name in names.items()):
        return "the names of its classes are missing"
    ids = state["class_ids"]
    if ids.dtype not in (torch.int32, torch.int64):
        return "class_ids are no whole numbers"
    unnamed = sorted(set(ids.unique().tolist()) - set(names)) if bool(state["assigned"]) else []
    return f"it gives Gaussians the class {unnamed[0]}, which has no name" if unnamed else None
