"""The trainer: nerfstudio's, with a schedule of two phases, checkpoints that survive a crash, and clear errors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import gettempdir
from typing import Any, cast

from filelock import BaseFileLock
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import profiler, writer
from nerfstudio.utils.decorators import check_main_thread

from beags_plugin.core.schedule import PhaseSchedule
from beags_plugin.importers.base import find_importer
from beags_plugin.objects.clean import decide
from beags_plugin.options.run_format import CONFIG_FILE
from beags_plugin.plugin.options.config import BeagsTrainerConfig
from beags_plugin.plugin.options.machine import check_machine
from beags_plugin.plugin.options.rollback import Rollback, noted
from beags_plugin.plugin.training.checkpoints import Checkpoints
from beags_plugin.plugin.training.memory_guard import NO_MEMORY, MemoryWatch, check_room, is_out_of_memory
from beags_plugin.plugin.training.optimizers import SceneOptimizer
from beags_plugin.plugin.training.resumable import GlobalRandom, Resumable
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.training.timing import Estimate, StageSeconds
from beags_plugin.plugin.training.warm_start import start_from_scene
from beags_plugin.plugin.viewer.serving import end_threads
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.runs.layout import REPORT_FILE
from beags_plugin.system.errors import UserError, is_of_disk, refused, silence_libraries
from beags_plugin.system.interrupts import Interrupts, stop
from beags_plugin.system.lock import run_lock
from beags_plugin.system.memory import peak_memory_mb
from beags_plugin.system.pasted import quoted
from beags_plugin.system.progress import say
from beags_plugin.system.reading.text import reason
from beags_plugin.system.whole_files import remove_unfinished, write_text_atomically


class BeagsTrainer(Trainer):
    """Trains a ``BeagsModel`` through its two phases."""

    config: BeagsTrainerConfig

    def __init__(self, config: BeagsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        silence_libraries()
        self.schedule = config.model_config.schedule()
        self.config = config
        self._steps_option = config.max_num_iterations
        self.reschedule(self.schedule)
        self.seconds = StageSeconds()
        self._interrupts = Interrupts(self._go_on)
        self._lock: BaseFileLock | None = None
        self._before: Rollback | None = None  # The run's folder before this training.
        self._watch = MemoryWatch(config.machine.device_type)
        self._done = 0  # The last step that was trained.
        self._complete = False
        super().__init__(config, local_rank, world_size)
        self._checkpoints = Checkpoints(config, self.base_dir, self.checkpoint_dir)

    def reschedule(self, schedule: PhaseSchedule) -> None:
        """Set the steps of this run, which some refiners compute from the data."""
        self.schedule = schedule
        self.last_step = self._steps_option or schedule.total
        self.config.max_num_iterations = self.last_step  # Nerfstudio prints percentages of it.

    @property
    def _model(self) -> SceneModel:
        return cast(SceneModel, self.pipeline.model)

    def setup(self, test_mode: Any = "val") -> None:
        """Load data, build the model, load a checkpoint; a user error ends the program with one sentence."""
        try:
            self._set_up(test_mode)
        except BaseException as error:
            self._stop(error)
            raise

    def _set_up(self, test_mode: Any) -> None:
        before = noted(self.base_dir)
        self._lock = run_lock(self.base_dir)
        self._before = before
        # config.yml is already this run's, and a resume would take old checkpoints for its own.
        self._checkpoints.set_aside()
        check_machine(self.config.machine)
        self.config.check()
        if (start := self._start()) is not None:
            find_importer(start)  # It raises before the data are read.
        used = any((self.base_dir / self.config.logging.relative_log_dir).glob("events.out.tfevents.*"))
        super().setup(test_mode)
        if self.config.check_memory:
            check_room(self.base_dir, self.config.machine.device_type)
        if used:
            self._forget_events()

    def _stop(self, error: BaseException) -> None:
        """Release the run after ``error``; exit with one sentence if there is one for it.

        There is one if memory ran out, the system refused a file, or the user made a mistake. A training that has saved
        no checkpoint then leaves no files.
        """
        self._close_writers(failed=True)
        profiler.PROFILER.clear()  # Its figures would be printed below the sentence.
        if (sentence := self._sentence(error)) is None:
            return self._release()
        undone = self._before is not None and self._before.undo()
        self._release()
        stop(UserError(NO_MEMORY) if undone and is_out_of_memory(error) else sentence)

    def _sentence(self, error: BaseException) -> UserError | None:
        if isinstance(error, UserError):
            return error
        if isinstance(error, Exception) and is_out_of_memory(error):
            return UserError(
                f"memory ran out after step {self._done} ({reason(error)}): the last checkpoint is whole. "
                f"Close other programs and go on with beags resume {quoted(self.base_dir)}, or begin anew with smaller "
                "photos or fewer Gaussians."
            )
        if not isinstance(error, OSError):
            return None
        if error.filename is None and is_of_disk(error):  # Nerfstudio's own writers raise such errors.
            return UserError(
                f"a file of {self.base_dir}, or a temporary one in {gettempdir()}, cannot be written "
                f"({error.strerror}): free some space there, or choose other places (--run-dir, TMPDIR)."
            )
        return refused(error)

    def _release(self) -> None:
        """Unlock the run's folder, and close the writers of curves with their threads."""
        self._close_writers()
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def _close_writers(self, failed: bool = False) -> None:
        for each in writer.EVENT_WRITERS:
            if isinstance(each, writer.TensorboardWriter):
                with suppress(OSError):  # A full disk has been reported already.
                    each.tb_writer.close()
            if failed and isinstance(each, writer.WandbWriter):
                import wandb

                wandb.finish(exit_code=1, quiet=True)  # Else it would print below the sentence.
        writer.EVENT_WRITERS.clear()
        writer.EVENT_STORAGE.clear()

    def _forget_events(self) -> None:
        """Drop tensorboard's events of steps that this run repeats, or of another run in this folder."""
        own = self.loaded_run == self.base_dir.absolute()
        for each in writer.EVENT_WRITERS:
            if isinstance(each, writer.TensorboardWriter):
                folder = each.tb_writer.log_dir
                each.tb_writer.close()
                each.tb_writer = type(each.tb_writer)(log_dir=folder, purge_step=self._start_step if own else 0)

    def _start(self) -> Path | None:
        """Return the scene to start from; None if a checkpoint is loaded instead."""
        start = self.config.model_config.start_from
        return None if start is None or self._checkpoints.loads else Path(start)

    def setup_optimizers(self) -> SceneOptimizer:
        """Build the scene's optimizer, once a scene to start from has replaced the parameters."""
        if self._start() is not None:
            start_from_scene(self._model, cast(BeagsDataManager, self.pipeline.datamanager), self.base_dir)
        return SceneOptimizer(self.config.optimizers.copy(), self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train to the end of the schedule, also after a resume (nerfstudio would train that many steps more)."""
        try:
            self._train()
        except BaseException as error:
            self._stop(error)
            raise
        finally:
            end_threads(self.viewer_state)
        self._release()

    def _train(self) -> None:
        self.config.max_num_iterations = max(self.last_step - self._start_step, 0)
        self.seconds.start()
        self.keep("seconds", self.seconds)
        if self.config.max_num_iterations == 0:
            if self.loaded_run == self.base_dir.absolute() and not (self.base_dir / REPORT_FILE).exists():
                return self._write_report()  # The run was killed after its last checkpoint.
            raise UserError(
                f"the checkpoint is of a complete run ({self._start_step} steps): nothing is left to train; "
                "to refine a base, this one or <run>/base/nerfstudio_models, load it with beags-refine."
            )
        self._estimate = Estimate(
            str(self.config.method_name),
            self.config.max_num_iterations,
            chosen=self._start_step == 0 and self.schedule.base_steps > 0,
        )
        remove_unfinished(self.base_dir)
        (self.base_dir / REPORT_FILE).unlink(missing_ok=True)  # It marks a run as complete.
        self.keep("random", GlobalRandom())
        self._checkpoints.drop_loaded_states()
        try:
            with self._interrupts:
                super().train()
        except KeyboardInterrupt as interrupt:
            if (self.base_dir / REPORT_FILE).exists():  # The signal ended the viewer of a complete run.
                return
            say(f"Stopped. To continue: beags resume {quoted(self.base_dir)}")
            raise SystemExit(self._interrupts.exit_code) from interrupt

    def train_iteration(self, step: int) -> Any:
        """Train one step; after some of them, print how long the run will take."""
        self._estimate.before_step(step - self._start_step)
        result = super().train_iteration(step)
        self._done = step
        return result

    # -- checkpoints -------------------------------------------------------------------------------------------------

    @property
    def loaded_run(self) -> Path | None:
        """The folder of the run that this one resumes; None if nothing was loaded."""
        return self._checkpoints.loaded_run

    @property
    def loaded_close_ups(self) -> bool | None:
        """Whether the loaded training saw close-ups of objects; None if nothing was loaded."""
        return self._checkpoints.loaded_close_ups

    def keep(self, name: str, part: Resumable) -> None:
        """Let checkpoints hold the state of ``part``, and restore that of the loaded one if there is any."""
        self._checkpoints.keep(name, part)

    def _load_checkpoint(self) -> None:
        path = self._checkpoints.path
        if path is not None:
            self._start_step = self._checkpoints.restore(path, self.pipeline, self.optimizers, self.grad_scaler)
            return
        if self.schedule.base_steps == 0 and self.config.model_config.start_from is None:
            raise UserError(
                f"{self.config.method_name} starts from a trained base: add --load-dir <run>/nerfstudio_models of "
                "one (or <run>/base/nerfstudio_models), or --pipeline.model.start-from with a splat .ply or "
                "another run."
            )
        super()._load_checkpoint()

    @check_main_thread
    def save_checkpoint(self, step: int) -> None:
        """Save all that decides the rest of the run, whole or not at all."""
        if not self._complete:  # Nerfstudio saves again at the end, with another step number.
            self._checkpoints.save(step, self.pipeline, self.optimizers, self.grad_scaler)

    # -- breaks --------------------------------------------------------------------------------------------------------

    def _go_on(self) -> None:
        """Let a training that the viewer has paused reach its next step, so that a signal can stop it."""
        if self.training_state == "paused":
            self.training_state = "training"

    def stop_if_requested(self, step: int) -> None:
        """Save the step before ``step`` and end, after a signal or if memory is running out."""
        if self._interrupts.signal is not None:
            if step > self._start_step:
                self._save_once(step - 1)
            raise KeyboardInterrupt
        if self.config.check_memory and step > self._start_step and (short := self._watch.short_of(step)) is not None:
            self._save_once(step - 1)
            raise UserError(
                f"{short}: saved and stopped after step {step - 1}. Close other programs and go on with beags resume "
                f"{self.base_dir}, or bound the Gaussians of a new run (--pipeline.model.densify.max-surfels)."
            )

    @contextmanager
    def long_stage(self, step: int) -> Iterator[None]:
        """Save ``step`` and enclose a long block, which a signal ends at once; a resumed run repeats it."""
        if step >= 0:
            self._save_once(step)
        self._interrupts.at_once = True
        try:
            if self._interrupts.signal is not None:
                raise KeyboardInterrupt
            yield
        finally:
            self._interrupts.at_once = False

    def _save_once(self, step: int) -> None:
        if self._checkpoints.saved_step != step:
            self.save_checkpoint(step)

    # -- the end -------------------------------------------------------------------------------------------------------

    def _after_train(self) -> None:
        self._interrupts.at_once = True  # A viewer may wait for Ctrl-C.
        self.save_checkpoint(self._done)
        self._complete = True
        self._write_report()
        decide(self.base_dir / CONFIG_FILE)
        super()._after_train()

    def _write_report(self) -> None:
        own = self._model.own_training
        figures = {} if own is None else own.figures()
        report = {"seconds": self.seconds.total(), "peak_memory_mb": peak_memory_mb(), **figures}
        write_text_atomically(json.dumps(report, indent=2), self.base_dir / REPORT_FILE)
