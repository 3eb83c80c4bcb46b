"""Rendering of features of a frozen scene or of some of its Gaussians alone, and training of such features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import log

import torch
from torch import Tensor

from beags_baselines.ranked_labels import ranked_labels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, TrainedScene
from beags_plugin.rasterizers.interface import SurfelInputs
from beags_plugin.rasterizers.rendering import draw_features, geometry_inputs


class FrozenDrawing:
    """Renders features of N frozen Gaussians; the P pixels of a view are one list, row by row."""

    def __init__(self, scene: TrainedScene) -> None:
        self.scene = scene
        self.inputs = geometry_inputs(scene.surfels())

    def __len__(self) -> int:
        return len(self.inputs.means)

    def draw(self, view: int, features: Tensor, own: Tensor | None = None, size: float = 1.0) -> tuple[Tensor, Tensor]:
        """Return sum_i w_i f_i [P, C] and alpha [P]; differentiable in the features, [M, C].

        own: [M] int64, the Gaussians to render alone; None for all. size: factor of their sizes.
        """
        rendered = self.channels(view, torch.cat([features, torch.ones_like(features[:, :1])], dim=1), own, size)
        return rendered[:, :-1], rendered[:, -1].detach()

    def channels(self, view: int, features: Tensor, own: Tensor | None = None, size: float = 1.0) -> Tensor:
        """Return only the first result of ``draw``."""
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


class FeatureTraining(OwnTraining):
    """Training of ``features``, one for each Gaussian; the scene stays fixed.

    first: [N, C], features to start from. views: purpose of the random numbers that order the views.
    """

    def __init__(self, scene: TrainedScene, first: Tensor, rate: float, views: int) -> None:
        self.scene, self.drawing, self._views = scene, FrozenDrawing(scene), views
        device = self.drawing.inputs.means.device
        self.ranks = ClassRanks(torch.tensor(list(scene.names), device=device))
        self.masked = [view for view, labels in enumerate(scene.labels) if bool((labels != IGNORE).any())]
        self.features = first.to(device).requires_grad_()
        self.adam = torch.optim.Adam([self.features], lr=rate, eps=1e-15)

    def rates(self, step: int) -> Mapping[str, float]:
        return {}

    def after_step(self, step: int) -> Edit | None:
        if self.features.grad is not None:
            self.adam.step()
        return None

    def view_of(self, step: int) -> int:
        """Return the view of a step; each epoch has all views with a mask, in a new order."""
        number, place = divmod(step, len(self.masked))
        order = torch.randperm(len(self.masked), generator=self.scene.generator(number, self._views))
        return self.masked[int(order[place])]

    def ranks_of(self, view: int) -> Tensor:
        """Return the labels of a view, [H, W] int32, ranks or IGNORE."""
        return ranked_labels(self.ranks, self.scene.labels[view].to(self.features.device))
