"""The trainer: nerfstudio's, with schedules that end where they should and checkpoints that survive a crash."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, cast

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.decorators import check_main_thread
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape

from beags_plugin.errors import UserError
from beags_plugin.plugin.held_out import HeldOutCurve
from beags_plugin.plugin.optimizers import JointOptimizers
from beags_plugin.plugin.refinement import peak_memory_mb
from beags_plugin.plugin.runs import newest_checkpoint, save_atomically
from beags_plugin.plugin.warm_start import check_start, start_from_scene

if TYPE_CHECKING:
    from beags_plugin.plugin.config import BeagsTrainerConfig
    from beags_plugin.plugin.datamanager import BeagsDataManager
    from beags_plugin.plugin.model import BeagsModel

QUICKER = "Quicker: ns-train beags-tiny, or end the command with: beags-data --downscale-factor 2."
LONG_RUN_SECONDS = 20 * 60  # a run that is expected to take longer says which preset is quicker
ESTIMATE_STEPS = (20, 120)  # the estimate is the mean step between these: after warm-up, soon enough to matter


class BeagsTrainer(Trainer):
    """Trains a ``BeagsModel`` through its two phases."""

    config: BeagsTrainerConfig

    def __init__(self, config: BeagsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        self.schedule = config.model_config.schedule()
        self.last_step = config.max_num_iterations or self.schedule.total
        config.max_num_iterations = self.last_step
        self.loaded_run: Path | None = None
        self.curve: HeldOutCurve | None = None
        self._started = 0.0
        super().__init__(config, local_rank, world_size)

    @property
    def _model(self) -> BeagsModel:
        return cast("BeagsModel", self.pipeline.model)

    def setup(self, test_mode: Any = "val") -> None:
        """Load data, build the model, load a checkpoint; a user's mistake ends here, with one sentence."""
        try:
            if not self._loads():
                check_start(self.config.model_config)
            super().setup(test_mode)
        except UserError as error:
            _stop(error)

    def setup_optimizers(self) -> JointOptimizers:
        """The optimizers that the config lists, one for each group of parameters.

        A scene to start from takes its place before: the optimizers hold what they are built with.
        """
        if self.config.model_config.start_from is not None and not self._loads():
            start_from_scene(self._model, cast("BeagsDataManager", self.pipeline.datamanager), self.base_dir)
        return JointOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train to the end of the schedule, also after a resume (nerfstudio would train that many steps more)."""
        self.config.max_num_iterations = max(self.last_step - self._start_step, 0)
        if self.config.max_num_iterations == 0:
            _stop(
                UserError(
                    f"the checkpoint is of a complete run ({self._start_step} steps): nothing is left to train; "
                    "to refine again, load <run>/base/nerfstudio_models with beags-refine."
                )
            )
        CONSOLE.print(
            f"{self.config.method_name}: {self.config.max_num_iterations} steps; how long they take is said after "
            f"{ESTIMATE_STEPS[1]} of them. {QUICKER}",
            highlight=False,
        )
        self._started = time.perf_counter()
        if self.config.steps_per_held_out > 0:
            datamanager = cast("BeagsDataManager", self.pipeline.datamanager)
            self.curve = HeldOutCurve(
                self.base_dir, self.config.steps_per_held_out, self.last_step, self._model, datamanager
            )
        try:
            super().train()
        except UserError as error:
            _stop(error)

    def train_iteration(self, step: int) -> Any:
        """One step; after some of them, says how long the run will take, or measures the held-out views."""
        done = step - self._start_step
        if done == ESTIMATE_STEPS[0]:
            self._estimate_from = time.perf_counter()
        if done == ESTIMATE_STEPS[1]:
            self._say_duration((time.perf_counter() - self._estimate_from) / (ESTIMATE_STEPS[1] - ESTIMATE_STEPS[0]))
        found = super().train_iteration(step)
        if self.curve is not None:
            self.curve.after_step(step)  # before the scene grows, from which it needs some steps to recover
        return found

    def _say_duration(self, seconds_per_step: float) -> None:
        left = (self.last_step - self._start_step) * seconds_per_step
        message = (
            f"About {_duration(left)} for {self.last_step - self._start_step} steps at the present speed "
            f"({1000 * seconds_per_step:.0f} ms a step; it slows down as Gaussians are added)."
        )
        if left > LONG_RUN_SECONDS:
            message += f" {QUICKER}"
        CONSOLE.print(message, highlight=False)

    def _loads(self) -> bool:
        """Whether a checkpoint is loaded: what it holds counts, not the scene that its run may have started from."""
        return self.config.load_dir is not None or self.config.load_checkpoint is not None

    def _load_checkpoint(self) -> None:
        config = self.config
        if config.load_dir is not None and config.load_step is None:
            config.load_checkpoint = newest_checkpoint(config.load_dir)
            config.load_dir = None
        if not self._loads() and config.model_config.start_from is None and self.schedule.base_steps == 0:
            raise UserError(
                f"{config.method_name} starts from a trained base: add --load-dir <run>/nerfstudio_models of one "
                "(or <run>/base/nerfstudio_models), or --pipeline.model.start-from with a splat .ply or another run."
            )
        super()._load_checkpoint()
        models = config.load_dir or (config.load_checkpoint.parent if config.load_checkpoint else None)
        self.loaded_run = models.absolute().parent if models else None
        if self.schedule.base_steps == 0 and int(self._model.refined_steps) == 0:
            self._start_step = 0  # a base that was loaded: refinement counts its own steps

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save model and optimizers; the file appears whole or not at all, and only then are older ones removed."""
        path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        content = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {},
            "scalers": self.grad_scaler.state_dict(),
        }
        save_atomically(content, path)
        if self.config.save_only_latest_checkpoint:
            for old in self.checkpoint_dir.glob("*.ckpt"):
                if old != path:
                    old.unlink()

    def _after_train(self) -> None:
        report = {"seconds": self._stage_seconds(), "peak_memory_mb": peak_memory_mb()}
        self.base_dir.mkdir(parents=True, exist_ok=True)
        (self.base_dir / "training.json").write_text(json.dumps(report, indent=2))
        super()._after_train()

    def _stage_seconds(self) -> dict[str, float]:
        """Wall time of base training, each preparation stage and refinement in this process."""
        total = time.perf_counter() - self._started
        prepared = self._model.prepared_seconds
        refining = time.perf_counter() - self._model.refining_since if prepared else 0.0
        return {"base training": total - sum(prepared.values()) - refining, **prepared, "refinement": refining}


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _stop(error: UserError) -> NoReturn:
    CONSOLE.print(f"[bold red]beags:[/bold red] {escape(str(error))}", highlight=False, soft_wrap=True)
    raise SystemExit(2) from error  # the cause is for callers from Python
