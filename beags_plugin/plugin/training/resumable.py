"""State that a checkpoint holds besides the scene and its optimizers."""

from __future__ import annotations

import random
from contextlib import AbstractContextManager
from pathlib import Path
from threading import Lock
from typing import Any, Protocol

import numpy as np
import torch

from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.plugin.training.optimizers import SceneOptimizer
from beags_plugin.plugin.training.timing import StageSeconds
from beags_plugin.runs.checkpoint_file import STATE
from beags_plugin.system.errors import UserError

VERSION = 1  # Version of the state under the key ``STATE``.


class Resumable(Protocol):
    """A part of the training whose state a checkpoint holds: tensors and plain values, as ``torch.load`` allows."""

    def state(self) -> dict[str, Any]:
        """Return the state that the next steps depend on."""
        ...

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``, as returned by ``state()``."""
        ...


class TrainingRun(Protocol):
    """The trainer as the parts of a training see it; ``BeagsTrainer`` describes the methods.

    base_dir: folder of the run. loaded_run: folder of the run that this one resumes. last_step: number of steps of the
    run. seconds: of its stages. optimizers: of the scene. train_lock: nerfstudio's, held during a step, so that the
    viewer waits.
    """

    config: BeagsTrainerConfig
    base_dir: Path
    last_step: int
    seconds: StageSeconds
    optimizers: SceneOptimizer
    train_lock: Lock

    @property
    def loaded_run(self) -> Path | None: ...

    @property
    def loaded_close_ups(self) -> bool | None: ...

    def reschedule(self, schedule: PhaseSchedule) -> None: ...

    def keep(self, name: str, part: Resumable) -> None: ...

    def stop_if_requested(self, step: int) -> None: ...

    def long_stage(self, step: int) -> AbstractContextManager[None]: ...

    def eval_iteration(self, step: int) -> None: ...


class GlobalRandom:
    """The process's shared generators, which losses of other packages may use; this package does not."""

    def state(self) -> dict[str, Any]:
        """Return the generators' states; see ``Resumable``."""
        numpy_state: Any = np.random.get_state()  # noqa: NPY002  (other packages use it)
        name, keys, *rest = numpy_state
        return {"torch": torch.get_rng_state(), "python": random.getstate(), "numpy": (name, keys.tolist(), *rest)}

    def restore(self, state: dict[str, Any]) -> None:
        """Set the generators to ``state``."""
        torch.set_rng_state(state["torch"])
        random.setstate(state["python"])
        name, keys, *rest = state["numpy"]
        np.random.set_state((name, np.array(keys, dtype=np.uint32), *rest))  # noqa: NPY002


def training_state(checkpoint: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the states of all parts of the training by name; none for a scene alone.

    Raises ``UserError`` for a checkpoint of a newer version, or a damaged one.
    """
    if (state := checkpoint.get(STATE)) is None:
        return {}
    if not (isinstance(state, dict) and isinstance(state.get("version"), int) and isinstance(state.get("parts"), dict)):
        raise UserError(f"the state of training in {path} is damaged: name an earlier checkpoint.")
    if state["version"] > VERSION:
        raise UserError(
            f"{path} was saved by a newer version of beags: update beags to train on from it (viewing and evaluation "
            "work)."
        )
    return state["parts"]
