"""Read checkpoint files and check them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.exposure import Exposures
from beags_plugin.core.membership import Membership
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors

_OF_GAUSSIAN: dict[str, tuple[int | None, ...]] = {
    "gauss_params.means": (3,), "gauss_params.quats": (4,), "gauss_params.scales": (2,), "gauss_params.opacities": (1,),
    "gauss_params.features_dc": (3,), "gauss_params.features_rest": (None, 3), "class_ids": (), "class_margin": (),
}  # fmt: skip
"""Shapes of the values of one Gaussian; None: any size."""
_NOT_FLOATS = ("class_ids", "assigned")
STATE = "beags"  # Key of the training's state in a checkpoint, beside nerfstudio's own keys.
SAW_CLOSE_UPS = "saw_close_ups"  # Key of a checkpoint without that state; true if its training saw close-ups.


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint to the CPU; raises ``UserError`` for any other file."""
    try:
        checkpoint = load_tensors(path)
    except FileNotFoundError:
        raise UserError(f"there is no checkpoint {path}: name one of an earlier run.") from None
    except ValueError as error:
        raise UserError(f"the checkpoint {path} is damaged ({error}): name an earlier one.") from error
    whole = isinstance(checkpoint, dict) and {"step", "pipeline", "optimizers", "scalers"} <= set(checkpoint)
    if not whole or not isinstance(checkpoint["pipeline"], dict) or type(checkpoint["step"]) is not int:
        raise UserError(f"{path} is no checkpoint of ns-train: name a step-….ckpt of a run.")
    return checkpoint


def extra_state(classes: Mapping[int, str], members: Membership, exposures: Exposures | None = None) -> dict[str, Any]:
    """Return what a model's state holds besides tensors by name: class names, objects and the photos' exposures.

    Objects are there only if they share Gaussians or leave some to nobody.
    """
    state: dict[str, Any] = {"classes": dict(classes)}
    if members.objects is not None:
        state["objects"] = {class_id: index.cpu() for class_id, index in members.objects.items()}
    if exposures is not None:
        state["exposures"] = {"names": list(exposures.names), "affine": exposures.affine.detach().cpu().clone()}
    return state


def exposures_of(extra: Mapping[str, Any]) -> Exposures | None:
    """Return the photos' exposures in what ``extra_state`` returned; None if all photos have the same."""
    known = extra.get("exposures")
    return None if known is None else Exposures(tuple(known["names"]), known["affine"])


def scene_alone(checkpoint: dict[str, Any]) -> bool:
    """Return whether the checkpoint lacks the state of a training, as in ``<run>/base`` and extracted runs."""
    return not checkpoint["optimizers"]


def saw_close_ups(checkpoint: Mapping[str, Any]) -> bool:
    """Return whether the training that a checkpoint is of saw close-ups of objects."""
    views = checkpoint.get(STATE, {}).get("parts", {}).get("views", {})
    return bool(checkpoint.get(SAW_CLOSE_UPS) or views.get("close_ups"))


def model_state(checkpoint: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """Return the model's state in a checkpoint; raises ``UserError`` if it is no scene. path: its file."""
    state = {name[7:]: value for name, value in checkpoint["pipeline"].items() if name.startswith("_model.")}
    validate(state, path)
    return state


def validate(state: Mapping[str, Any], path: Path) -> None:
    """Raise ``UserError`` unless ``state`` is the state of a ``BeagsModel``. path: its file."""
    if wrong := _wrong(state):
        raise UserError(f"the checkpoint {path} holds no scene of beags ({wrong}): name another, or train again.")


def _wrong(state: Mapping[str, Any]) -> str | None:
    means = state.get("gauss_params.means")
    count = len(means) if isinstance(means, Tensor) and means.dim() else -1
    shapes = {name: (count, *shape) for name, shape in _OF_GAUSSIAN.items()}
    for name, shape in {**shapes, "assigned": (), "extent": ()}.items():
        value = state.get(name)
        if not isinstance(value, Tensor):
            return f"{name} is missing"
        if value.dim() != len(shape) or any(a not in (b, None) for a, b in zip(shape, value.shape, strict=True)):
            return f"{name} is {list(value.shape)}, not {list(shape)}"
        if value.is_complex() or value.is_floating_point() == (name in _NOT_FLOATS):
            return f"{name} holds {value.dtype}"
    if (bands := state["gauss_params.features_rest"].shape[1]) not in (0, 3, 8, 15):
        return f"gauss_params.features_rest has {bands} colour bands"
    extra = state.get("_extra_state")
    names = extra.get("classes") if isinstance(extra, dict) else None
    if not isinstance(names, dict):
        return "the names of its classes are missing"
    assert isinstance(extra, dict)
    objects = extra.get("objects", {})
    if not isinstance(objects, dict) or not all(_is_index(each, count) for each in objects.values()):
        return "the Gaussians of its objects are not among its own"
    if (known := extra.get("exposures")) is not None and not _is_exposures(known):
        return "the exposures of its photos are damaged"
    used = set(objects) | set(state["class_ids"].unique().tolist() if bool(state["assigned"]) else [])
    unnamed = sorted(used - set(names))
    return f"it gives Gaussians the class {unnamed[0]}, which has no name" if unnamed else None


def _is_exposures(value: Any) -> bool:
    """Return whether a value holds the names of V photos and their transforms [V, 3, 4] float."""
    names, affine = (value.get(key) for key in ("names", "affine")) if isinstance(value, dict) else (None, None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return False
    if not isinstance(affine, Tensor) or affine.shape != (len(names), 3, 4):
        return False
    return affine.is_floating_point() and bool(affine.isfinite().all())


def _is_index(value: Any, count: int) -> bool:
    """Return whether a value holds indices [M] int64 of ``count`` Gaussians."""
    if not isinstance(value, Tensor) or value.dim() != 1 or value.dtype != torch.int64:
        return False
    return len(value) == 0 or (int(value.min()) >= 0 and int(value.max()) < count)
