"""The switch from base training to refinement, and its files for a resume."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.core.cameras import Camera
from beags_plugin.labels.classes import read_id_mask, write_mask
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.runs.layout import BASE_SNAPSHOT, PREPARED, round_folder
from beags_plugin.plugin.runs.prepared import PREPARATION_REPORT, read_grid
from beags_plugin.plugin.runs.write import write_run
from beags_plugin.plugin.training.contradiction import Residuals, residuals
from beags_plugin.plugin.training.resumable import TrainingRun
from beags_plugin.plugin.training.scene_edits import edit_scene
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.preparation.pipeline import Preparation, check_masks, prepare
from beags_plugin.refiners import REFINERS
from beags_plugin.system import processes
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.memory import peak_memory_mb
from beags_plugin.system.progress import counted, progress_bar
from beags_plugin.system.whole_files import write_text_atomically, write_whole


class RefinementSwitch:
    """Prepares refinement once the base is trained, or restores it in a resumed run."""

    def __init__(self, model: SceneModel, trainer: TrainingRun, datamanager: BeagsDataManager) -> None:
        self.model = model
        self.trainer = trainer
        self.datamanager = datamanager
        self.refiner = REFINERS.get(model.config.refiner)()
        self.ready = False  # to refine
        self._switching = False  # in the middle of the last base step, before nerfstudio evaluates and saves it
        self._evaluation_due = False
        self._done: int | None = None  # host copy of refined_steps, which lies on the GPU
        self.rounds = 0  # prepared so far, in this process and those that it resumes
        model.prepared_rounds = 0

    @property
    def wanted(self) -> bool:
        """True if this run refines at all."""
        return self.model.config.refine_steps > 0

    def check(self) -> None:
        """Raise ``UserError`` for options and masks that would stop the run when it begins to refine."""
        if self.wanted:
            rounds, steps = self.model.config.refine_rounds, self.model.config.refine_steps
            if not 1 <= rounds <= steps:
                raise UserError(f"refine_rounds is {rounds}: it must be 1 to refine_steps, which is {steps}.")
            self.model.config.prepare.check()
            self.model.config.split.check()
            check_masks(view.labels for view in self.datamanager.views("train", original=True))

    def state(self) -> dict[str, Any]:
        """Return the number of prepared rounds, and whether nerfstudio has evaluated the step; see ``Resumable``."""
        return {"rounds": self.rounds, "evaluated": not self._switching}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on in the round of ``state``."""
        self.rounds = state["rounds"]
        self._evaluation_due = not state["evaluated"]

    def before_step(self, step: int) -> None:
        """Restore refinement from a checkpoint, or start it where no base step precedes it."""
        model = self.model
        if not self.wanted or not model.schedule.refining(step):
            return
        done = self._done = int(model.refined_steps) if self._done is None else self._done
        if not self.ready:
            self.rounds = max(self.rounds, sum(start < done for start in self._round_starts()))
            if self.rounds > 0:
                self._restore_files()
        if sum(start <= done for start in self._round_starts()) > self.rounds:
            self._prepare(step - 1)
        if self._evaluation_due:
            self.trainer.eval_iteration(step - 1)
            self._evaluation_due = False
        model.refined_steps += 1
        self._done += 1

    def after_step(self, step: int) -> None:
        """Switch right after the last base step, so that a run that ends there has its classes too."""
        if self.wanted and not self.ready and step + 1 == self.model.schedule.base_steps:
            self._switching = True
            self._prepare(step)
            self._switching = False

    def _round_starts(self) -> list[int]:
        return self.model.schedule.round_starts(self.model.config.refine_rounds)

    def _prepare(self, step: int) -> None:
        """Prepare a round from the scene as it is and the masks of the data. step: the last one done."""
        model, first = self.model, self.rounds == 0
        CONSOLE.rule("Preparing refinement" if first else "Preparing refinement again, with the refined depth")
        start = time.perf_counter()
        with self.trainer.long_stage(step):
            views = self.datamanager.views("train", original=True)
            with _bar("Reading masks", passing=True) as progress:
                masks = LabelMaps(view.labels for view in counted(views, len(views), progress))
            fit = residuals(model, views, masks) if first and self.datamanager.config.photos == "all" else None
            with released(self.trainer.train_lock):  # minutes, which only read the scene: a viewer may render it
                prepared = prepare(
                    model.surfels(),
                    [view.camera for view in views],
                    masks,
                    model.classes,
                    model.rasterizer,
                    model.settings(),
                    self.refiner,
                    model.config.prepare,
                    model.config.split,
                    background_voxels=self._background_voxels(),
                    seed=model.seed,
                    stage=_bar,
                )
            for line in prepared.summary:
                CONSOLE.print(f"  {line}", highlight=False, markup=False)
            self._take_classes(prepared.assignment)
            if first:  # before save_prepared, whose last file marks everything as there
                snapshot = self.trainer.base_dir / BASE_SNAPSHOT
                write_run(self.trainer.config, snapshot, model.state_dict(), max(step, 0))
                CONSOLE.print(f"  base kept in {snapshot}", highlight=False, markup=False, soft_wrap=True)
            if fit is not None and fit.contradict:
                CONSOLE.print(fit.sentence(), style="yellow", highlight=False, markup=False, soft_wrap=True)
            folder = round_folder(self.trainer.base_dir, self.rounds)
            save_prepared(prepared, [view.name for view in views], folder, fit)
            if prepared.edited is not None:
                edit_scene(model, self.trainer.optimizers.adam, prepared.edited.edited)
                self._take_classes(prepared.edited.assignment)
            self.rounds += 1
            self._start(prepared.grid, prepared.labels)
        self.trainer.seconds.prepared(prepared.seconds, time.perf_counter() - start, first)

    def _background_voxels(self) -> bool:
        return any(loss.asks_grid_about_background for loss in self.model.losses.values())

    def _take_classes(self, assignment: Assignment) -> None:
        self.model.class_ids.copy_(assignment.class_ids)
        self.model.class_margin.copy_(assignment.margin)
        self.model.assigned.fill_(True)

    def _start(self, grid: VisibilityGrid | None, labels: LabelMaps) -> None:
        self.datamanager.replace_labels(labels)
        self.model.grid = None if grid is None else grid.to(self.model.device)
        self.model.frozen = not self.refiner.trains
        self.model.prepared_rounds = self.rounds
        self.ready = True

    def _restore_files(self) -> None:
        """Read the masks and the grid of the run that the checkpoint came from, and copy them into this one."""
        folder = round_folder(self.trainer.base_dir, self.rounds - 1)
        former = self.trainer.loaded_run
        if former is not None and former != self.trainer.base_dir:
            _clear(self.trainer.base_dir / PREPARED)
            for name in (PREPARED, BASE_SNAPSHOT):
                if (former / name).is_dir():
                    shutil.copytree(former / name, self.trainer.base_dir / name, dirs_exist_ok=True)
        if not (folder / "grid.pt").exists():
            raise UserError(
                f"{former} was refining, but its folder {PREPARED} with masks and voxel grids is missing: restore it, "
                f"or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        grid = read_grid(folder / "grid.pt")
        if grid is not None and self._background_voxels() and not bool((grid.classes == 0).any()):
            raise UserError(
                f"{folder / 'grid.pt'} has no voxels of the background, which a loss now asks about: set background of "
                f"the occupancy loss to False, or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        views = self.datamanager.views("train")
        with _bar("Reading masks", passing=True) as progress:
            labels = LabelMaps(
                _prepared_labels(folder / "masks" / f"{view.name}.png", view.camera)
                for view in counted(views, len(views), progress)
            )
        self._start(grid, labels)
        self.trainer.seconds.refining()
        CONSOLE.print(f"  refinement taken up from {folder}", highlight=False, markup=False, soft_wrap=True)


def _bar(name: str, passing: bool = False) -> AbstractContextManager[Callable[[int, int], None]]:
    """Open a progress bar, in the first of several processes."""
    return progress_bar(name, passing) if processes.rank() == 0 else nullcontext(lambda done, total: None)


def _prepared_labels(path: Path, camera: Camera) -> torch.Tensor:
    """Read the labels [H, W] int32 of a prepared mask; raises ``UserError`` if it does not fit the camera."""
    if not path.is_file():
        raise UserError(
            f"the prepared mask {path} is missing: restore it, or refine again from base/nerfstudio_models."
        )
    labels = torch.from_numpy(read_id_mask(path).astype(np.int32))
    if labels.shape != (camera.height, camera.width):
        raise UserError(
            f"the prepared mask {path} is {labels.shape[1]}x{labels.shape[0]} pixels but its view is "
            f"{camera.width}x{camera.height}: restore the data, or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
        )
    return labels


def save_prepared(prepared: Preparation, names: list[str], folder: Path, fit: Residuals | None = None) -> None:
    """Write what a resumed refinement needs; grid.pt comes last, as its presence marks the rest as complete.

    fit: of the base to the photos, for the report, where it was measured.
    """
    with writing(folder):
        (folder / "grid.pt").unlink(missing_ok=True)  # an earlier run's
        if folder.name == PREPARED:
            _clear(folder)
        (folder / "masks").mkdir(parents=True, exist_ok=True)
        (folder / "confidence").mkdir(exist_ok=True)
    with _bar("Keeping masks", passing=True) as progress:
        for index, name in enumerate(counted(names, len(names), progress)):
            labels = prepared.labels[index]
            write_mask(folder / "masks" / f"{name}.png", labels.cpu().numpy().astype(np.uint16))
            if prepared.confidence is not None:
                path = folder / "confidence" / f"{name}.png"
                with writing(path):  # cv2 would ignore a full disk
                    Image.fromarray(prepared.confidence[index].cpu().numpy()).save(path)
    report = {"summary": prepared.summary, "seconds": prepared.seconds, "peak_memory_mb": peak_memory_mb()}
    if fit is not None:
        report["residuals"] = {**vars(fit), "contradict": fit.contradict}
    write_text_atomically(json.dumps(report, indent=2), folder / PREPARATION_REPORT)
    state = {} if prepared.grid is None else prepared.grid.state_dict()
    write_whole(folder / "grid.pt", lambda file: torch.save(state, file))


def _clear(folder: Path) -> None:
    """Remove the files of another run in the same folder, later rounds too."""
    for path in folder.glob("*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


@contextmanager
def released(lock: Lock) -> Iterator[None]:
    """Release a held lock inside the block."""
    lock.release()
    try:
        yield
    finally:
        lock.acquire()
