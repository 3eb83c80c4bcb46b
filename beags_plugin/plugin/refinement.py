"""The switch from base training to refinement, and what of it is kept on disk for resuming."""

from __future__ import annotations

import json
import os
import resource
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.utils.rich_utils import CONSOLE

from beags_plugin.assignment.assignment import Assignment
from beags_plugin.errors import UserError
from beags_plugin.masks.classes import read_class_map, write_class_map
from beags_plugin.masks.label_maps import LabelMaps
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.plugin.runs import BASE_SNAPSHOT, PREPARED, round_folder, write_run
from beags_plugin.plugin.scene_edits import edit_scene
from beags_plugin.progress import progress_bar
from beags_plugin.refiners import REFINERS
from beags_plugin.refiners.preparation import Preparation, prepare

if TYPE_CHECKING:
    from beags_plugin.plugin.datamanager import BeagsDataManager
    from beags_plugin.plugin.model import BeagsModel


class RefinementSwitch:
    """Prepares refinement once the base is trained, or takes it up again in a resumed run."""

    def __init__(self, model: BeagsModel, trainer: Any, datamanager: BeagsDataManager) -> None:
        self.model = model
        self.trainer = trainer
        self.datamanager = datamanager
        self.refiner = REFINERS.get(model.config.refiner)()
        self.ready = False

    @property
    def wanted(self) -> bool:
        """Whether this run refines at all."""
        return self.model.config.refine_steps > 0

    def check_masks(self) -> None:
        """Raise ``UserError`` at the start of a run that would find no mask when it comes to refine."""
        masks = self.datamanager.train_dataset.metadata["class_map_filenames"]
        if self.wanted and all(path is None for path in masks):
            raise UserError(
                "no training view has a mask: put id images into masks/<image name>.png, or train the preset "
                "beags-base, which needs none."
            )

    def check_options(self) -> None:
        """Raise ``UserError`` at the start of a run whose options would stop it when it comes to refine."""
        if self.wanted:
            rounds, steps = self.model.config.refine_rounds, self.model.config.refine_steps
            if not 1 <= rounds <= steps:
                raise UserError(f"refine_rounds is {rounds}: it must be 1 to refine_steps, which is {steps}.")
            self.model.config.prepare.check()
            self.model.config.split.check()

    def before_step(self, step: int) -> None:
        """Take up refinement that a checkpoint was in, or start it where no base step precedes it."""
        model = self.model
        if not self.wanted or not model.schedule.refining(step):
            return
        done = int(model.refined_steps)
        if not self.ready and done > 0:
            self._take_up()
        if not self.ready or (done > 0 and done in self._round_starts()):
            self._prepare(step - 1)
        model.refined_steps += 1

    def after_step(self, step: int) -> None:
        """Switch right after the last base step, so that a run that ends there has its classes too."""
        if self.wanted and not self.ready and step + 1 == self.model.schedule.base_steps:
            self._prepare(step)

    def _round_starts(self) -> list[int]:
        """The refinement steps before which masks, classes and grids are made, the first of them 0."""
        steps, rounds = self.model.schedule.refine_steps, self.model.config.refine_rounds
        return [steps * index // rounds for index in range(rounds)]

    def _round(self) -> int:
        """Index of the round that the next step belongs to."""
        done = int(self.model.refined_steps)
        return sum(start <= done for start in self._round_starts()) - 1

    def _folder(self, index: int) -> Path:
        return round_folder(self.trainer.base_dir, index)

    def _prepare(self, step: int) -> None:
        """Prepare a round from the scene as it is and the masks as the data has them. step: the last one done."""
        model = self.model
        first = self._round() == 0
        views = self.datamanager.views("train", original=True)
        CONSOLE.rule("Preparing refinement" if first else "Preparing refinement again, with the refined depth")
        with released(self.trainer.train_lock):  # minutes, which read the scene only: a viewer may draw it
            prepared = prepare(
                model.surfels(),
                [view.camera for view in views],
                LabelMaps(view.stored_labels for view in views),
                model.classes,
                model.rasterizer,
                model.settings(),
                self.refiner,
                model.config.prepare,
                model.config.split,
                background_voxels=self._background_voxels(),
                seed=model.seed,
                stage=progress_bar,
            )
        for finding in prepared.findings:
            CONSOLE.print(f"  {finding}", highlight=False, markup=False)
        self._take_classes(prepared.assignment)
        if first:  # the snapshot first: what _save writes last says that everything is there
            write_run(self.trainer.config, self.trainer.base_dir / BASE_SNAPSHOT, model.state_dict(), max(step, 0))
        self._save(prepared, [view.name for view in views])
        if prepared.edited is not None:
            edit_scene(model, self.trainer.optimizers.optimizers, prepared.edited.edited)
            self._take_classes(prepared.edited.assignment)
        self._start(prepared.grid, prepared.labels, self._round() + 1 < model.config.refine_rounds)
        self._count(prepared.seconds, first)
        if first:
            CONSOLE.print(
                f"  base kept in {self.trainer.base_dir / BASE_SNAPSHOT}", highlight=False, markup=False, soft_wrap=True
            )

    def _count(self, seconds: dict[str, float], first: bool) -> None:
        """Add the time of a preparation to that of the stages; it is none of the refinement's."""
        model = self.model
        model.refining_since = time.perf_counter() if first else model.refining_since + sum(seconds.values())
        total = model.prepared_seconds
        model.prepared_seconds = {name: total.get(name, 0.0) + seconds.get(name, 0.0) for name in {**total, **seconds}}

    def _background_voxels(self) -> bool:
        return any(loss.asks_grid_about_background for loss in self.model.losses.values())

    def _take_classes(self, assignment: Assignment) -> None:
        self.model.class_ids.copy_(assignment.class_ids)
        self.model.class_margin.copy_(assignment.margin)
        self.model.assigned.fill_(True)

    def _start(self, grid: VisibilityGrid | None, labels: LabelMaps, more_rounds: bool) -> None:
        """more_rounds: whether one is still to be prepared, from the masks as the data has them."""
        self.datamanager.replace_class_maps(labels, keep=more_rounds)
        self.model.grid = grid
        self.model.frozen = not self.refiner.trains
        self.ready = True

    def _save(self, prepared: Preparation, names: list[str]) -> None:
        """Keep what refinement needs; grid.pt is written last, so its presence says that all is there."""
        folder = self._folder(self._round())
        if folder.name == PREPARED:  # what an earlier run left here
            shutil.rmtree(folder, ignore_errors=True)
        (folder / "masks").mkdir(parents=True, exist_ok=True)
        (folder / "confidence").mkdir(exist_ok=True)
        for index, name in enumerate(names):
            labels = prepared.labels[index]
            write_class_map(folder / "masks" / f"{name}.png", labels.cpu().numpy().astype(np.uint16))
            if prepared.confidence is not None:
                _write_grey(folder / "confidence" / f"{name}.png", prepared.confidence[index])
        report = {"findings": prepared.findings, "seconds": prepared.seconds, "peak_memory_mb": peak_memory_mb()}
        (folder / "report.json").write_text(json.dumps(report, indent=2))
        state = {} if prepared.grid is None else prepared.grid.state_dict()
        torch.save(state, folder / "grid.pt.part")
        os.replace(folder / "grid.pt.part", folder / "grid.pt")

    def _take_up(self) -> None:
        """Go on with the masks and grids of the run that the checkpoint came from, and keep them with this one."""
        done = int(self.model.refined_steps)
        folder = self._folder(sum(start < done for start in self._round_starts()) - 1)
        former = self.trainer.loaded_run
        if former is not None and former != self.trainer.base_dir:
            for name in (PREPARED, BASE_SNAPSHOT):
                if (former / name).is_dir():
                    shutil.copytree(former / name, self.trainer.base_dir / name, dirs_exist_ok=True)
        if not (folder / "grid.pt").exists():
            raise UserError(
                f"{former} was refining, but its folder {PREPARED} with masks and voxel grids is missing: restore it, "
                f"or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        state = torch.load(folder / "grid.pt", weights_only=True)
        if state and self._background_voxels() and not bool((state["classes"] == 0).any()):
            raise UserError(
                f"{folder / 'grid.pt'} has no voxels of the background, which a loss now asks about: set background of "
                f"the occupancy loss to False, or refine again from {BASE_SNAPSHOT}/nerfstudio_models."
            )
        labels = LabelMaps(
            torch.from_numpy(read_class_map(folder / "masks" / f"{view.name}.png").astype(np.int32))
            for view in self.datamanager.views("train")
        )
        more_rounds = any(start >= int(self.model.refined_steps) for start in self._round_starts())
        self._start(VisibilityGrid.from_state_dict(state) if state else None, labels, more_rounds)
        self.model.refining_since = time.perf_counter()
        CONSOLE.print(f"  refinement taken up from {folder}", highlight=False, markup=False, soft_wrap=True)


@contextmanager
def released(lock: Lock) -> Iterator[None]:
    """Let others have a lock that is held, and take it back."""
    lock.release()
    try:
        yield
    finally:
        lock.acquire()


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB of 10^6 bytes."""
    with suppress(OSError, StopIteration):  # Linux only; getrusage's would count what the parent process once held
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e6
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


def _write_grey(path: Path, values: torch.Tensor) -> None:
    import cv2

    cv2.imwrite(str(path), values.cpu().numpy())
