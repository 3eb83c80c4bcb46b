"""How well a run draws the views that it does not train on, measured now and then while it trains."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from beags_plugin.losses.photometric import ssim
from beags_plugin.plugin.runs.layout import write_text_atomically
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.progress import counted, progress_bar

if TYPE_CHECKING:
    from beags_plugin.plugin.model import BeagsModel
    from beags_plugin.plugin.views.datamanager import BeagsDataManager
    from beags_plugin.plugin.views.views import View

CURVE = "held_out.json"
"""File of a run: one record per measurement, see ``HeldOutCurve``."""


class HeldOutCurve:
    """Quality against steps, kept in ``<run>/held_out.json``.

    A record holds ``step`` (steps done), ``gaussians``, ``psnr`` (dB) and ``ssim`` of the held-out views (means over
    them), ``train_psnr`` of as many training views spread over all, and ``seconds`` and ``cpu_seconds`` of training so
    far, without what the measurements took. Only colours are drawn: a view costs a fraction of a step.
    """

    def __init__(self, folder: Path, every: int, last: int, model: BeagsModel, datamanager: BeagsDataManager) -> None:
        self.file = folder / CURVE
        self.every = every
        self.ends = {model.schedule.base_steps, last}
        self.model = model
        self.held_out = datamanager.views("eval")
        train = datamanager.views("train")
        count = min(len(self.held_out), len(train))
        self.train = [train[index * len(train) // count] for index in range(count)]
        self.records: list[dict[str, float]] = []
        self._started = _clocks()

    def state(self) -> dict[str, Any]:
        """The curve so far, and the clocks; see ``training_state.Part``."""
        now = _clocks()
        return {"records": list(self.records), "clocks": {name: now[name] - self._started[name] for name in now}}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with the curve of the run that gave ``state``."""
        self.records = list(state["records"])
        self._started = {name: now - state["clocks"][name] for name, now in _clocks().items()}

    def after_step(self, step: int) -> None:
        """Measure if the time has come: at every multiple of ``every`` steps, and where a phase ends."""
        done = step + 1
        if done % self.every == 0 or done in self.ends:
            began = _clocks()
            used = {name: began[name] - self._started[name] for name in began}
            self.records.append({**self._measure(done), **used})
            write_text_atomically(json.dumps(self.records, indent=1), self.file)
            self._started = {name: self._started[name] + now - began[name] for name, now in _clocks().items()}

    def _measure(self, done: int) -> dict[str, float]:
        views = [*self.held_out, *self.train]
        with progress_bar("Measuring held-out views", passing=True) as progress:
            qualities = [self._quality(view) for view in counted(views, len(views), progress)]
        psnr, similarity = zip(*qualities[: len(self.held_out)], strict=True)
        train_psnr = [quality for quality, _ in qualities[len(self.held_out) :]]
        return {
            "step": done,
            "gaussians": self.model.num_points,
            "psnr": sum(psnr) / len(psnr),
            "ssim": sum(similarity) / len(similarity),
            "train_psnr": sum(train_psnr) / len(train_psnr),
        }

    @torch.no_grad()
    def _quality(self, view: View) -> tuple[float, float]:
        model = self.model
        background = model.background_color.to(model.device)
        image = view.image_on(background)
        drawn = model.rasterizer.rasterize(
            surfel_inputs(model.surfels(), view.camera, model.active_sh_degree()),
            view.camera,
            model.settings(geometry=False),
            background,
        ).color.clamp(0.0, 1.0)
        error = (drawn - image).square().mean().clamp_min(1e-10)
        return float(-10.0 * torch.log10(error)), float(ssim(drawn, image))


def _clocks() -> dict[str, float]:
    return {"seconds": time.perf_counter(), "cpu_seconds": time.process_time()}
