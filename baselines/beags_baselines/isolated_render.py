"""Draws features of a scene that stays as it is, or of some of its Gaussians alone."""

from __future__ import annotations

from dataclasses import replace
from math import log

import torch
from torch import Tensor

from beags_plugin.preparation.refiner_training import TrainedScene
from beags_plugin.rasterizers.interface import SurfelInputs
from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs


class FrozenDrawing:
    """Draws N Gaussians without gradients to them; P pixels of a view come as one list, row by row."""

    def __init__(self, scene: TrainedScene) -> None:
        self.scene = scene
        self.inputs = geometry_inputs(scene.surfels())

    def __len__(self) -> int:
        return len(self.inputs.means)

    def draw(self, view: int, features: Tensor, own: Tensor | None = None, size: float = 1.0) -> tuple[Tensor, Tensor]:
        """Return sum_i w_i f_i [P, C] and alpha [P]; differentiable in the features, [M, C].

        own: [M] int64, the Gaussians that are drawn, alone; None: all. size: factor of their sizes.
        """
        drawn = self.channels(view, torch.cat([features, torch.ones_like(features[:, :1])], dim=1), own, size)
        return drawn[:, :-1], drawn[:, -1].detach()

    def channels(self, view: int, features: Tensor, own: Tensor | None = None, size: float = 1.0) -> Tensor:
        """Return the first of ``draw`` alone."""
        inputs, scene = self.inputs if own is None else self._only(own), self.scene
        if size != 1.0:
            inputs = replace(inputs, log_scales=inputs.log_scales + log(size))
        return draw_features(scene.rasterizer, inputs, features, scene.cameras[view], scene.settings).flatten(0, 1)

    def visible(self, view: int) -> Tensor:
        """Return which Gaussians reach the image, [N] bool."""
        scene, black = self.scene, self.inputs.means.new_zeros(3)
        with torch.no_grad():
            return scene.rasterizer.rasterize(self.inputs, scene.cameras[view], scene.settings, black).visible

    def _only(self, own: Tensor) -> SurfelInputs:
        floats = ("means", "quats", "log_scales", "opacity_logits", "colors")
        return SurfelInputs(**{name: getattr(self.inputs, name)[own] for name in floats})
