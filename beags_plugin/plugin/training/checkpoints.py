"""Save and restore the checkpoints of a run, and set aside those of an earlier run."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any, cast

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.pipelines.base_pipeline import Pipeline
from torch.cuda.amp.grad_scaler import GradScaler

from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.plugin.options.rollback import REPLACED
from beags_plugin.plugin.training.resumable import VERSION, Resumable, training_state
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.runs.checkpoint_file import STATE, model_state, read_checkpoint, saw_close_ups
from beags_plugin.runs.layout import REPORT_FILE, newest_checkpoint
from beags_plugin.runs.write import save_atomically
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.system.reading.text import reason

_MISFITS = (RuntimeError, LookupError, ValueError, TypeError, AttributeError)  # Raised by foreign states.


class Checkpoints:
    """Saves and restores the checkpoints of one run.

    loaded_run: the folder of the run that this one resumes; None before ``restore``. loaded_close_ups: whether the
    loaded training saw close-ups; None before ``restore``. saved_step: the last one saved.
    """

    def __init__(self, config: BeagsTrainerConfig, base_dir: Path, folder: Path) -> None:
        self.config, self.base_dir, self.folder = config, base_dir, folder
        self.loaded_run: Path | None = None
        self.loaded_close_ups: bool | None = None
        self._parts: dict[str, Resumable] = {}
        self._loaded_states: dict[str, Any] = {}
        self._loaded_from: Path | None = None
        self.saved_step: int | None = None

    # -- what is loaded ------------------------------------------------------------------------------------------------

    @property
    def loads(self) -> bool:
        """Return whether a checkpoint is loaded, in which case ``start_from`` has no effect."""
        return self.config.load_dir is not None or self.config.load_checkpoint is not None

    @property
    def path(self) -> Path | None:
        """The file to load, as the config names it."""
        config = self.config
        if config.load_dir is None:
            return config.load_checkpoint
        if config.load_step is None:
            return newest_checkpoint(config.load_dir)
        return config.load_dir / f"step-{config.load_step:09d}.ckpt"

    def restore(self, path: Path, pipeline: Pipeline, optimizers: Optimizers, scaler: GradScaler) -> int:
        """Restore pipeline, optimizers and scaler from a checkpoint; return the next step.

        ``keep`` restores the other parts later. Raises ``UserError`` for a file that is no checkpoint, does not fit
        this run, or refines other classes.
        """
        checkpoint = read_checkpoint(path)
        states = training_state(checkpoint, path)
        model = cast(SceneModel, pipeline.model)
        classes = dict(model.classes)  # The data's; loading replaces them.
        model_state(checkpoint, path)
        try:
            pipeline.load_pipeline(checkpoint["pipeline"], checkpoint["step"])
            optimizers.load_optimizers(checkpoint["optimizers"])
            scaler.load_state_dict(checkpoint["scalers"])
        except _MISFITS as error:
            raise _misfit(path, error) from error
        if model.classes != classes:
            if self.config.continues(self.base_dir) or int(model.refined_steps) > 0:
                raise UserError(
                    f"the classes of {self.config.data_path} are not those with which training began "
                    f"({', '.join(model.classes.values())}): restore classes.json and the masks, or train again."
                )
            model.take_classes(classes)  # Refinement assigns the classes of a base anew.
            states.pop("refinement", None)
        say(f"Loaded {path}")
        self.loaded_close_ups = saw_close_ups(checkpoint)
        continues = self.config.continues(self.base_dir)
        self.loaded_run = self.base_dir.absolute() if continues else path.absolute().parent.parent
        if model.schedule.base_steps == 0 and int(model.refined_steps) == 0:
            return 0  # Refinement of a loaded base begins at its own step 0.
        self._loaded_states, self._loaded_from = states, path
        return checkpoint["step"] + 1

    # -- what is saved -------------------------------------------------------------------------------------------------

    def keep(self, name: str, part: Resumable) -> None:
        """Let checkpoints hold the state of ``part``, and restore that of the loaded one if there is any."""
        self._parts[name] = part
        if name in self._loaded_states:
            try:
                part.restore(self._loaded_states[name])
            except _MISFITS as error:
                raise _misfit(self._loaded_from, error, name) from error

    def drop_loaded_states(self) -> None:
        """Drop the loaded states of parts that this run does not have."""
        self._loaded_states = {}

    def save(self, step: int, pipeline: Pipeline, optimizers: Optimizers, scaler: GradScaler) -> None:
        """Save all that decides the rest of the run; older files are removed once the new one is whole."""
        path = self.folder / f"step-{step:09d}.ckpt"
        content = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.optimizers.items()},
            "schedulers": {},
            "scalers": scaler.state_dict(),
            STATE: {"version": VERSION, "parts": {name: part.state() for name, part in self._parts.items()}},
        }
        save_atomically(content, path)
        self.saved_step = step
        if self.config.save_only_latest_checkpoint:
            for old in self.folder.glob("*.ckpt"):
                if old != path:
                    old.unlink()
        shutil.rmtree(self.base_dir / REPLACED, ignore_errors=True)

    def set_aside(self) -> None:
        """Move away the checkpoints of an earlier run in this folder, and remove its report."""
        if self.config.continues(self.base_dir):
            return
        (self.base_dir / REPORT_FILE).unlink(missing_ok=True)
        if any(self.folder.glob("*.ckpt")):
            former = self.base_dir / REPLACED
            shutil.rmtree(former, ignore_errors=True)
            self.folder.rename(former)
            say(
                f"{self.base_dir} holds an earlier run; its checkpoint is in {REPLACED} until this one saves its "
                "first. (beags resume continues a run instead.)"
            )


def _misfit(path: Path | None, error: Exception, part: str = "") -> UserError:
    """Return the error for a checkpoint that is whole, but of another run, or changed."""
    state = f"the state of {part} in {path}" if part else f"{path}"
    return UserError(
        f"{state} does not fit this run ({reason(error)}): name an earlier checkpoint, or refine again from "
        "base/nerfstudio_models."
    )
