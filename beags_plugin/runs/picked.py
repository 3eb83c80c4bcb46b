"""What was picked and corrected in the viewer, beside a run's checkpoint: other classes for the same Gaussians."""

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

PICKED_FILE = "picked.pt"  # in a run's folder; deleted, the run is as it was trained


def write_picked(run: Path, means: Tensor, members: Membership, classes: Mapping[int, str]) -> Path:
    """Keep the classes of a run's Gaussians, whose centres are ``means`` [N, 3], beside its checkpoint."""
    path = run / PICKED_FILE
    content = {"gaussians": _digest(means), "class_ids": members.class_ids.cpu().int(), **extra_state(classes, members)}
    write_whole(path, lambda file: torch.save(content, file))
    return path


def with_picked(state: dict[str, Any], run: Path) -> dict[str, Any]:
    """Return a model's state with the classes that were picked, if any were for its Gaussians.

    What was picked for others, as before the run was trained on, is left alone, and a line says so. Raises
    ``UserError`` if the file is damaged.
    """
    path = run / PICKED_FILE
    if not path.exists():
        return state
    try:
        kept = load_tensors(path)
        if not isinstance(kept, dict):
            raise ValueError("it holds something else")
        fits = kept["gaussians"] == _digest(state["gauss_params.means"])
        former = {name: value for name, value in state["_extra_state"].items() if name != "objects"}
        extra = {**former, **{name: kept[name] for name in ("classes", "objects") if name in kept}}
        changed = {**state, "class_ids": kept["class_ids"], "assigned": torch.tensor(True), "_extra_state": extra}
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path}, what was picked in the viewer, is damaged ({error}): delete it.") from error
    if not fits:
        say(f"{path} was picked before the run was trained on, and fits it no longer: pick again, or delete it.")
        return state
    validate(changed, path)
    return changed


def _digest(means: Tensor) -> str:
    return hashlib.sha256(means.detach().cpu().contiguous().numpy().tobytes()).hexdigest()
