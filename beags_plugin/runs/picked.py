"""The file of classes that were picked in the viewer, beside a run's checkpoint."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.runs.checkpoint_file import extra_state, validate
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.reading.tensors import load_tensors
from beags_plugin.system.whole_files import write_whole

PICKED_FILE = "picked.pt"  # It lies in a run's folder; without it the run has its trained classes.


def write_picked(run: Path, means: Tensor, members: Membership, classes: Mapping[int, str]) -> Path:
    """Store classes for a run's Gaussians, whose centres are ``means`` [N, 3], beside its checkpoint."""
    path = run / PICKED_FILE
    content = {"gaussians": _digest(means), "class_ids": members.class_ids.cpu().int(), **extra_state(classes, members)}
    write_whole(path, lambda file: torch.save(content, file))
    return path


def with_picked(state: dict[str, Any], run: Path) -> dict[str, Any]:
    """Return a model's state with the picked classes, if there are any for its Gaussians.

    A file for other Gaussians, as before the run was trained on, changes nothing, and a line says so. Raises
    ``UserError`` if the file is damaged.
    """
    path = run / PICKED_FILE
    if not path.exists():
        return state
    try:
        content = load_tensors(path)
        if not isinstance(content, dict):
            raise ValueError("it holds something else")
        fits = content["gaussians"] == _digest(state["gauss_params.means"])
        former = {name: value for name, value in state["_extra_state"].items() if name != "objects"}
        extra = {**former, **{name: content[name] for name in ("classes", "objects") if name in content}}
        changed = {**state, "class_ids": content["class_ids"], "assigned": torch.tensor(True), "_extra_state": extra}
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path}, what was picked in the viewer, is damaged ({error}): delete it.") from error
    if not fits:
        say(f"{path} was picked before the run was trained on, and fits it no longer: pick again, or delete it.")
        return state
    validate(changed, path)
    return changed


def _digest(means: Tensor) -> str:
    return hashlib.sha256(means.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
