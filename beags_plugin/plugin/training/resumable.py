"""What a checkpoint keeps besides the scene and its optimizers: all that decides the rest of a run."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.tensors import load_tensors

STATE = "beags"
"""Key of a checkpoint, beside nerfstudio's own."""
VERSION = 1
"""Of what lies there; another version is not read."""


class Part(Protocol):
    """A part of the training whose state a checkpoint holds: tensors and plain values, as ``torch.load`` allows."""

    def state(self) -> dict[str, Any]:
        """What decides how the part goes on."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Go on as the part that gave ``state`` would have."""
        ...


class GlobalRandom:
    """The generators that programs share. This package draws from none of them; losses of other packages may."""

    def state(self) -> dict[str, Any]:
        """See ``Part``."""
        numpy_state: Any = np.random.get_state()  # noqa: NPY002  (that of others, not one to draw from)
        name, keys, *rest = numpy_state
        return {"torch": torch.get_rng_state(), "python": random.getstate(), "numpy": (name, keys.tolist(), *rest)}

    def restore(self, state: dict[str, Any]) -> None:
        """See ``Part``."""
        torch.set_rng_state(state["torch"])
        random.setstate(state["python"])
        name, keys, *rest = state["numpy"]
        np.random.set_state((name, np.array(keys, dtype=np.uint32), *rest))  # noqa: NPY002


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


def training_state(checkpoint: dict[str, Any], path: Path) -> dict[str, Any]:
    """The states of all parts of the training by name; says so if there are none to go on from bit for bit.

    Raises ``UserError`` for a checkpoint of a newer version, or a damaged one.
    """
    state = checkpoint.get(STATE)
    if state is not None and not (
        isinstance(state, dict) and isinstance(state.get("version"), int) and isinstance(state.get("parts"), dict)
    ):
        raise UserError(f"the state of training in {path} is damaged: name an earlier checkpoint.")
    if state is not None and state["version"] > VERSION:
        raise UserError(
            f"{path} was saved by a newer version of beags: update beags to train on from it (viewing and evaluation "
            "work)."
        )
    if state is None or state["version"] < VERSION:
        if not scene_alone(checkpoint):
            CONSOLE.print(
                f"{path} was saved by an older version of beags, which kept neither the order of the views nor what "
                "growth had gathered: training goes on, but not bit for bit as without the break.",
                highlight=False, markup=False, soft_wrap=True,
            )  # fmt: skip
        return {}
    return state["parts"]
