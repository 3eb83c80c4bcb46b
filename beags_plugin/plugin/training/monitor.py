"""Measure a run while it trains: curves for tensorboard and wandb."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from nerfstudio.configs import base_config  # noqa: F401  (the writer fails if it is imported before)
from nerfstudio.utils import writer

from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.evaluation.metrics import mask_metrics
from beags_plugin.evaluation.protocol import Protocol
from beags_plugin.evaluation.records import EvalView
from beags_plugin.evaluation.run_metrics import MaskRenderer
from beags_plugin.evaluation.violations import boundary_errors, occupancy_violations
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.labels.colors import colorize
from beags_plugin.plugin.training.scene_model import SceneModel, picture
from beags_plugin.rasterizers.rendering import render_class_map, surfel_inputs
from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import memory_mb, peak_memory_mb
from beags_plugin.system.progress import progress_bar, say

MOST_CLASSES = 20  # Classes, the first by id, with a curve and a picture each.
VIEWS = 4  # Evenly spaced held-out views on which masks are measured.


class Curves:
    """Writes curves through nerfstudio's writers: to tensorboard, wandb and comet.

    views: held out. every: steps between two measurements of masks and pictures, which also happen at the first and the
    last step with classes; 0: never. last: number of steps of the run. log_every: steps between two other scalars.
    """

    def __init__(self, model: SceneModel, views: Sequence[EvalView], every: int, last: int, log_every: int) -> None:
        self.model = model
        self.every = every
        self.last = last
        self.log_every = log_every
        self._all_views = views
        self._views: list[EvalView] | None = None
        self._measured = False  # Whether objects have been measured.

    def state(self) -> dict[str, Any]:
        """Return whether objects have been measured; see ``resumable.Resumable``."""
        return {"measured": self._measured}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``."""
        self._measured = state["measured"]

    def before_step(self, step: int) -> None:
        """Make up for the measurement that an interrupted preparation prevented after the last step."""
        model = self.model
        due = self.every > 0 and step > 0 and not self._measured and model.schedule.refining(step)
        due = due and model.own_training is None
        if due and bool(model.assigned):  # Read last, because a step must not wait for a GPU.
            self._objects(step - 1)

    def after_step(self, step: int) -> None:
        """Write what is due after ``step`` (from 0); objects are measured once Gaussians have classes."""
        model = self.model
        if self.log_every > 0 and step % self.log_every == 0:
            writer.put_scalar("Memory (MB)/now", memory_mb(), step)
            writer.put_scalar("Memory (MB)/peak", peak_memory_mb(), step)
            self._boundaries(step)
        done = step + 1
        due = self.every > 0 and (not self._measured or done % self.every == 0 or done == self.last)
        has_objects = model.own_training is None or done == self.last  # Such a refiner has none before.
        if due and has_objects and model.schedule.refining(done) and bool(model.assigned):
            self._objects(step)

    def _named(self, values: dict[int, float]) -> dict[str, float]:
        names = dict(sorted(self.model.classes.items())[:MOST_CLASSES])
        return {names[index]: value for index, value in values.items() if index in names}

    def _boundaries(self, step: int) -> None:
        """Write the boundary errors of the training view that was just rendered."""
        last = self.model.last_render
        if last is not None and last.labels is not None and last.render.boundary is not None:
            errors = boundary_errors(last.render.boundary.detach(), last.labels)
            for name, error in self._named(errors).items():
                writer.put_scalar(f"Boundary error/{name}", error, step)

    @torch.no_grad()
    def _objects(self, step: int) -> None:
        """Write extracted IoU on some held-out views, occupancy violations, and pictures of one of the views."""
        self._measured = True
        with progress_bar("Measuring objects", passing=True) as progress:
            self._measure(step, progress)

    def _measure(self, step: int, progress: Callable[[int, int], None]) -> None:
        """Measure and write; ``progress`` is called with (done, total) of the masks and pictures."""
        model = self.model
        surfels, members = model.surfels().detach(), model.members()
        if model.grid is not None:
            shares = occupancy_violations(surfels, model.class_ids, model.grid, model.seed, step)
            shares.pop(BACKGROUND, None)  # It holds every Gaussian of no object, even where nothing was seen.
            for name, share in self._named(shares).items():
                writer.put_scalar(f"Occupancy violation/{name}", share, step)
        views = self._measured_views()
        objects = [index for index in sorted(model.classes)[:MOST_CLASSES] if index != BACKGROUND]
        parts = {index: select_class(surfels, members, index)[0] for index in objects}
        settings = model.settings(geometry=False)
        renderers = [MaskRenderer(surfels, members, view, model.rasterizer, settings, Protocol()) for view in views]
        values: list[float] = []
        done, total = 0, len(objects) * (len(views) + 1)
        for index in objects:
            scores = []
            for renderer in renderers:
                progress(done := done + 1, total)
                for mask in renderer.masks("extracted", [index]).values():
                    scores.append(mask_metrics(mask.prediction, mask.truth, mask.ignore).iou)
            scores = [score for score in scores if score is not None]
            if scores:
                writer.put_scalar(f"Extracted IoU/{model.classes[index]}", float(np.mean(scores)), step)
                values += scores
        if values:
            writer.put_scalar("Extracted IoU/mean", float(np.mean(values)), step)
        if views:
            self._pictures(step, views[0], parts, lambda rendered: progress(done + rendered, total))

    def _measured_views(self) -> list[EvalView]:
        """Return the held-out views to measure; none if they cannot be read, so that training continues."""
        if self._views is None:
            try:
                views, count = self._all_views, min(VIEWS, len(self._all_views))
                self._views = [views[(2 * index + 1) * len(views) // (2 * count)] for index in range(count)]
            except UserError as error:
                say(f"Extracted IoU and pictures are left out of the curves: {error}", warning=True)
                self._views = []
        return self._views

    def _pictures(
        self, step: int, view: EvalView, parts: Mapping[int, Surfels], progress: Callable[[int], None]
    ) -> None:
        model, camera = self.model, view.camera
        surfels, settings = model.surfels().detach(), model.settings(geometry=False)
        classes, _ = render_class_map(model.rasterizer, surfels, model.class_ids, camera, settings)
        colors = colorize(classes.cpu().numpy().astype(np.uint16))
        writer.put_image("Scene/class map", torch.from_numpy(colors).float() / 255.0, step)
        for rendered, (index, part) in enumerate(parts.items(), start=1):
            progress(rendered)
            if len(part):
                image = picture(model, surfel_inputs(part, camera), camera)
                writer.put_image(f"Objects/{model.classes[index]}", image, step)
