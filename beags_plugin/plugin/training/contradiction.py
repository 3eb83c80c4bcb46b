"""Detect photos that contradict each other outside the masks, as when objects turned while the room stood still."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.plugin.training.scene_model import SceneModel, picture
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.views.views import View

MOST_VIEWS = 24  # Views rendered to measure the residuals.
LIMIT_DB = 8.0
"""Least difference of PSNR inside and outside the masks for a contradiction. The generated turntable has 12, each of
five consistent scenes 2 at most (notes/poses.md)."""


@dataclass(frozen=True)
class Residuals:
    """PSNR of a trained base over the pixels of training views inside the masks' objects and outside, dB."""

    inside: float
    outside: float

    @property
    def contradict(self) -> bool:
        """Return whether the background fits so much worse that it cannot have stood still."""
        return self.inside - self.outside > LIMIT_DB

    def sentence(self) -> str:
        """Return the result and what to do."""
        return (
            f"Outside the masks the photos contradict each other ({self.outside:.1f} dB there, {self.inside:.1f} dB "
            "inside): if the objects turned while the room stood still, train anew with "
            "--pipeline.datamanager.photos objects."
        )


@torch.no_grad()
def residuals(model: SceneModel, views: Sequence[View], labels: Sequence[Tensor | None]) -> Residuals | None:
    """Measure the scene on some training views with labels; None if no pixel lies inside or none outside."""
    known = [index for index in range(len(views)) if labels[index] is not None]
    errors, pixels = torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    background = model.background_color.to(model.device)
    for index in known[:: max(1, math.ceil(len(known) / MOST_VIEWS))]:
        view, ids = views[index], labels[index]
        assert ids is not None
        inputs = surfel_inputs(model.surfels(), view.camera)
        if model.photo_colors is not None:
            inputs = replace(inputs, colors=model.photo_colors(inputs.colors, index))
        color = picture(model, inputs, view.camera)
        error = (color - view.image_on(background).to(color)).square().mean(-1).cpu()
        for side, part in enumerate(((ids != BACKGROUND) & (ids != IGNORE), ids == BACKGROUND)):
            errors[side] += error[part.cpu()].double().sum()
            pixels[side] += part.sum().cpu()
    if not bool(pixels.all()):
        return None
    inside, outside = (-10.0 * (errors / pixels).clamp_min(1e-10).log10()).tolist()
    return Residuals(inside, outside)
