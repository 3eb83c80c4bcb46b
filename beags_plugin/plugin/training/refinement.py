"""The switch from base training to refinement, also in a resumed run."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from threading import Lock
from typing import Any

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.core.membership import Membership
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.training.contacts import close_contacts
from beags_plugin.plugin.training.contradiction import residuals
from beags_plugin.plugin.training.prepared_files import clear, save_prepared
from beags_plugin.plugin.training.resumable import TrainingRun
from beags_plugin.plugin.training.scene_edits import apply_edit
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.preparation.pipeline import check_masks, check_options, prepare
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, TrainedScene
from beags_plugin.refiners import make_refiner
from beags_plugin.runs.layout import BASE_SNAPSHOT, PREPARED
from beags_plugin.runs.prepared import dropped_background, prepared_labels, read_grid
from beags_plugin.runs.write import write_run
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import counted, progress_bar, say
from beags_plugin.views.views import View

NOTHING_TO_SAVE = -1  # It stands for no step.


class RefinementSwitch:
    """Prepares refinement once the base is trained, or restores it in a resumed run."""

    def __init__(self, model: SceneModel, trainer: TrainingRun, datamanager: BeagsDataManager) -> None:
        self.model = model
        self.trainer = trainer
        self.datamanager = datamanager
        self.refiner = make_refiner(model.config.refiner, model.config.refiner_options)
        self._own_state: dict[str, Any] | None = None  # ``own_training``'s in a loaded checkpoint.
        self.ready = False  # Whether refinement can begin.
        self._switching = False  # True in the last base step, until nerfstudio evaluates and saves it.
        self._evaluation_due = False
        self.prepared = False  # A resumed run may have been prepared before.
        model.prepared = False

    @property
    def refines(self) -> bool:
        """Return whether this run refines at all."""
        return self.model.schedule.refine_steps > 0

    def ask_steps(self) -> None:
        """Set the number of refinement steps, which the refiner may compute from the data."""
        if not self.refines:
            return
        self.refiner.check(self.model.classes)
        schedule, views = self.model.schedule, len(self.datamanager.train_dataset)
        steps = self.refiner.steps(schedule.refine_steps, views, len(self.model.classes) - 1)
        self.model.schedule = replace(schedule, refine_steps=steps)
        self.trainer.reschedule(self.model.schedule)

    def check(self) -> None:
        """Raise ``UserError`` for options and masks with which refinement could not begin."""
        config = self.model.config
        if self.refiner.joins_base and config.base_steps == 0:
            raise UserError("the refiner's option joint trains a base of its own: set base_steps, and load no base.")
        if config.refine_steps > 0:
            check_options(config.prepare)
        if config.refine_steps > 0 or self.refiner.joins_base:
            check_masks(view.labels for view in self.datamanager.views("train", original=True))

    def state(self) -> dict[str, Any]:
        """Return whether refinement is prepared, and nerfstudio has evaluated the step; see ``Resumable``."""
        own = self.model.own_training
        of_refiner = {} if own is None else {"own": own.state(), "refiner": self._refiner_in_words()}
        return {"prepared": self.prepared, "evaluated": not self._switching, **of_refiner}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``."""
        self.prepared = state["prepared"]
        self._evaluation_due = not state["evaluated"]
        self._own_state = state.get("own")
        now, began = self._refiner_in_words(), state.get("refiner")
        if self.prepared and began != (None if self.refiner.leaves_base or self.refiner.trains else now):
            raise UserError(
                f"refinement began with the refiner {began or 'bea or none'}, not with {now}: continue with that, or "
                f"refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )

    def _refiner_in_words(self) -> str:
        config = self.model.config
        return " ".join(
            [config.refiner, *(f"{name}={value}" for name, value in sorted(config.refiner_options.items()))]
        )

    def before_step(self, step: int) -> None:
        """Join the base; restore refinement from a checkpoint, or start it if no base step precedes it."""
        model = self.model
        if self.refiner.joins_base and model.own_training is None:
            self._join_base()
        if not self.refines or not model.schedule.refining(step):
            return
        if not self.ready:
            if self.prepared or int(model.refined_steps) > 0:
                self._restore_files()
            else:
                self._prepare(step - 1)
        if self._evaluation_due:
            self.trainer.eval_iteration(step - 1)
            self._evaluation_due = False
        if self._closes_after(step):  # That may take minutes, so the training is saved before.
            with self.trainer.long_stage(step - 1):
                pass
        model.refined_steps += 1
        if (own := model.own_training) is not None:
            self._edit(lambda: own.before_step(step - model.schedule.base_steps))

    def after_step(self, step: int) -> None:
        """Switch to refinement right after the last base step, so that a run that ends there has classes too."""
        own, refined = self.model.own_training, step - self.model.schedule.base_steps
        if own is not None and refined >= 0:
            self._edit(lambda: own.after_step(refined))
            if refined + 1 == self.model.schedule.refine_steps:
                self._finish(own)
            elif step + 1 == self.trainer.last_step:
                say(
                    f"The refiner {self.model.config.refiner} was stopped before its end: the objects are those of "
                    "assignment, not yet its own.",
                    warning=True,
                )
        if self._closes_after(step):
            self._close_contacts()
        if self.refines and not self.ready and step + 1 == self.model.schedule.base_steps:
            self._switching = True
            self._prepare(step)
            self._switching = False

    def _edit(self, make: Callable[[], Edit | None]) -> None:
        with released(self.trainer.train_lock):  # Making it may take minutes.
            edit = make()
        apply_edit(self.model, self.trainer.optimizers.adam, edit)

    def _finish(self, own: OwnTraining) -> None:
        """Apply the refiner's last edit, and take its objects."""
        self._edit(own.last_edit)
        with released(self.trainer.train_lock):
            members = own.finish()
        if members is not None:
            self.model.take_members(members)

    def _closes_after(self, step: int) -> bool:
        model, last = self.model, self.model.schedule.base_steps + self.model.schedule.refine_steps - 1
        by_losses = self.ready and self.refiner.trains and model.own_training is None and model.objects is None
        return model.config.close_contacts and by_losses and step == last

    def _close_contacts(self) -> None:
        """Add the Gaussians that close objects where others hid them; if that fails, warn and leave them open."""
        try:
            with (
                self.trainer.long_stage(NOTHING_TO_SAVE),
                released(self.trainer.train_lock),
                progress_bar("Closing what neighbours hide") as progress,
            ):
                edit, line = close_contacts(self.model, self.datamanager, progress)
            apply_edit(self.model, self.trainer.optimizers.adam, edit)
            say(f"  {line}")
        except Exception as error:  # The scene is trained, and complete without these Gaussians.
            reason = str(error).partition("\n")[0]
            say(
                f"Objects stay open where others hide them, as closing them failed ({reason}): beags export has "
                "--close.",
                warning=True,
            )

    def _prepare(self, step: int) -> None:
        """Prepare refinement from the present scene and the masks of the data. step: the last one done."""
        model = self.model
        say("Preparing refinement")
        start = time.perf_counter()
        with self.trainer.long_stage(step):
            whole = self.datamanager.views("train", original=True)
            views = [*whole, *self.datamanager.close_up_views()]
            masks = _labels(views)
            fit = residuals(model, whole, masks[: len(whole)]) if self.datamanager.config.photos == "all" else None
            with released(self.trainer.train_lock):  # For minutes the scene is only read, so a viewer may render it.
                prepared = prepare(
                    model.surfels(),
                    [view.camera for view in views],
                    masks,
                    model.classes,
                    model.rasterizer,
                    model.settings(),
                    self.refiner,
                    model.config.prepare,
                    background_voxels=self._background_voxels(),
                    seed=model.seed,
                    scale=self._scale(),
                    stage=progress_bar,
                    photos=len(whole),
                )
            for line in prepared.summary:
                say(f"  {line}")
            self._take_classes(prepared.assignment)
            snapshot = self.trainer.base_dir / BASE_SNAPSHOT  # The last file of save_prepared marks it as complete.
            write_run(
                self.trainer.config, snapshot, model.state_dict(), max(step, 0), close_ups=len(views) > len(whole)
            )
            say(f"  base kept in {snapshot}")
            if fit is not None and fit.contradict:
                say(fit.sentence(), warning=True)
            names = [view.name for view in views]
            folder = self.trainer.base_dir / PREPARED
            save_prepared(prepared, names, folder, self._background_voxels(), fit, self.datamanager.magnified)
            if prepared.members is not None:  # Set after base/ is written, which holds the classes alone.
                model.take_members(prepared.members)
            self._start(prepared.grid, prepared.labels)
        self.trainer.seconds.prepared(prepared.seconds, time.perf_counter() - start)

    def _background_voxels(self) -> bool:
        return any(loss.asks_grid_about_background for loss in self.model.losses.values())

    def _take_classes(self, assignment: Assignment) -> None:
        self.model.class_ids.copy_(assignment.class_ids)
        self.model.objects = None  # A loaded base may have another refiner's.
        self.model.class_margin.copy_(assignment.margin)
        self.model.assigned.fill_(True)

    def _scale(self) -> float:
        """Return the units of the run's frame per unit of the input poses'."""
        return float(self.datamanager.train_dataparser_outputs.dataparser_scale)

    def _start(self, grid: VisibilityGrid | None, labels: LabelMaps) -> None:
        photos = len(self.datamanager.train_dataset)
        self.datamanager.replace_labels(labels[:photos], labels[photos:])
        self.model.grid = None if grid is None else grid.to(self.model.device)
        own = self._own_training(self._scene(labels[:photos]))
        self.model.frozen = own is None and not self.refiner.trains
        self.model.prepared = self.prepared = self.ready = True

    def _join_base(self) -> None:
        scene = self._scene(_labels(self.datamanager.views("train")))
        if not bool(self.model.assigned):  # A resumed run has its classes already.
            self.model.take_members(Membership(self.refiner.seed_classes(scene)))
        self._own_training(scene)

    def _own_training(self, scene: TrainedScene) -> OwnTraining | None:
        own = self.refiner.own_training(scene)
        if own is not None and self._own_state is not None:
            own.restore(self._own_state)
        self.model.own_training = own
        return own

    def _scene(self, labels: LabelMaps) -> TrainedScene:
        model = self.model
        return TrainedScene(
            surfels=model.surfels,
            class_ids=lambda: model.class_ids,
            cameras=[view.camera for view in self.datamanager.views("train")],
            labels=labels,
            names=model.classes,
            rasterizer=model.rasterizer,
            settings=model.settings(geometry=False),
            seed=model.seed,
            steps=model.schedule.refine_steps,
            base_steps=model.schedule.base_steps,
            extent=model.extent_on_host(),
            scale=self._scale(),
            stage=progress_bar,
        )

    def _restore_files(self) -> None:
        """Read the masks and the grid of the run that the checkpoint came from, and copy them into this one."""
        folder = self.trainer.base_dir / PREPARED
        former = self.trainer.loaded_run
        if former is not None and former != self.trainer.base_dir:
            clear(folder)
            for name in (PREPARED, BASE_SNAPSHOT):
                if (former / name).is_dir():
                    shutil.copytree(former / name, self.trainer.base_dir / name, dirs_exist_ok=True)
        if not (folder / "grid.pt").exists():
            raise UserError(
                f"{former} was refining, but its folder {PREPARED} with masks and voxel grids is missing: restore it, "
                f"or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        grid = read_grid(folder / "grid.pt")
        if grid is not None and self._background_voxels() and dropped_background(folder):
            raise UserError(
                f"{folder / 'grid.pt'} has no voxels of the background, which a loss now needs: set background of "
                f"the occupancy loss to 0, or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        views = [*self.datamanager.views("train"), *self.datamanager.close_up_views()]
        with progress_bar("Reading masks", passing=True) as progress:
            labels = LabelMaps(
                prepared_labels(folder / "masks" / f"{view.name}.png", view.camera).to(self.model.device)
                for view in counted(views, len(views), progress)
            )
        self._start(grid, labels)
        self.trainer.seconds.refining()
        say(f"  refinement continues from {folder}")


def _labels(views: Sequence[View]) -> LabelMaps:
    with progress_bar("Reading masks", passing=True) as progress:
        return LabelMaps(view.labels for view in counted(views, len(views), progress))


@contextmanager
def released(lock: Lock) -> Iterator[None]:
    """Release a held lock inside the block."""
    lock.release()
    try:
        yield
    finally:
        lock.acquire()
