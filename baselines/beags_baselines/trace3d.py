"""Trace3D as a refiner: Gaussians that straddle objects are removed during further training (``instance_tracing``).

Differences from the source: masks have ids that agree between views, so that merging of masks, the contrastive features
that make them agree, and the query by a mask in one view are left out; counts are exact (the source's kernel adds
without atomics and loses some) and of labelled pixels only; the loss is the base's at that step (the source's has its
term of normals from the first step); with another number of steps than 9,000 the cycles scale, at the same rates; if
all Gaussians would be removed, the most opaque one stays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import get_args

import torch
from torch import Tensor

from beags_baselines import instance_tracing as tracing
from beags_plugin.assignment.contributions import Product, contributions
from beags_plugin.core.densification import Densified, split_by_sampling
from beags_plugin.core.membership import Membership
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import LossInputs
from beags_plugin.preparation.refiner import Refiner
from beags_plugin.preparation.refiner_training import Edit, OwnTraining, Terms, TrainedScene
from beags_plugin.rasterizers.optional import optional_products
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.system.errors import UserError, check_choice
from beags_plugin.system.progress import each_view

WEIGHTS = ("count", "alpha")
RATES = {"features_dc": 2.5e-3, "features_rest": 1.25e-4, "opacities": 0.05, "scales": 0.005, "quats": 0.001}


@dataclass(frozen=True)
class Trace3DRefiner(Refiner):
    """Trains with the base's losses; each Gaussian has at most one class at the end."""

    weights: str = WEIGHTS[0]
    """Weight of a pixel: count, 1; alpha, the blending weight."""
    position_lr: str = tracing.POSITION_RATE
    """Rate of the centres: released (0) or intended."""
    min_pixels: int = tracing.MIN_PIXELS
    """Pixels of a Gaussian that counts in a view; small photos need fewer."""
    min_share: float = tracing.MIN_SHARE
    """Share of its largest class below which it is ambiguous."""
    max_ambiguous: float = tracing.MAX_AMBIGUOUS
    """Share of ambiguous views beyond which it is split."""
    member_share: float = tracing.MEMBER_SHARE
    """Share of its pixels that makes a member."""

    def __post_init__(self) -> None:
        check_choice(self.weights, WEIGHTS, "weight of a pixel")
        check_choice(self.position_lr, get_args(tracing.PositionRate), "schedule of the positions")
        if self.min_pixels < 0:
            raise UserError(f"min_pixels is {self.min_pixels}: give a number of pixels, 0 or more.")
        for name, least in (("min_share", 0.0), ("max_ambiguous", 0.0), ("member_share", 0.5)):
            if not least <= (value := getattr(self, name)) <= 1.0:
                raise UserError(f"{name} is {value:g}: give a share, {least:g} to 1.")

    def steps(self, requested: int, views: int, objects: int) -> int:
        return requested

    def own_training(self, scene: TrainedScene) -> OwnTraining:
        return TraceTraining(scene, self)


class TraceTraining(OwnTraining):
    """Has no state: the step determines the edits. A step before an edit trains nothing, as in the source."""

    def __init__(self, scene: TrainedScene, options: Trace3DRefiner) -> None:
        self.scene, self.options = scene, options
        self.cycles = tracing.cycle_steps(scene.steps)
        self.counts = options.weights == "count"
        self.num_classes = max(scene.names) + 1

    def rates(self, step: int) -> Mapping[str, float]:
        schedule: tracing.PositionRate = "intended" if self.options.position_lr == "intended" else "released"
        return {**RATES, "means": tracing.position_rate(step + 1, self.scene.extent, self.scene.steps, schedule)}

    def before_step(self, step: int) -> Edit | None:
        return Edit(fresh_adam=True) if step == 0 else None

    def terms(self, inputs: LossInputs, step: int, base: Callable[[], Terms]) -> Terms:
        return {} if step + 1 in (1, *self.cycles, self.scene.steps) else base()

    def after_step(self, step: int) -> Edit | None:
        edited = Densified.unchanged(self.scene.surfels().detach())
        if step == 0:
            edited = self._composited(edited)
        if step + 1 in self.cycles:
            chosen = self._ambiguous(edited.surfels)
            edited = edited.then(split_by_sampling(edited.surfels, chosen, self.scene.generator(step)))
            edited = edited.only(~self._ambiguous(edited.surfels))
        return Edit(edited) if step == 0 or step + 1 in self.cycles else None

    def last_edit(self) -> Edit:
        return Edit(self._composited(Densified.unchanged(self.scene.surfels().detach())))

    def finish(self) -> Membership:
        """Return the classes; a member has more than half of its pixels in its class."""
        scene, surfels = self.scene, self.scene.surfels().detach()
        views = (surfels, scene.cameras, scene.labels, scene.rasterizer, scene.settings, self.num_classes)
        with scene.stage("Taking the objects") as progress:
            class_ids, top, total = contributions(*views, progress, self._product()).largest()
        inside = tracing.members(top, total, self.options.member_share)
        return Membership(class_ids.int().masked_fill(~inside, 0))

    def _product(self) -> Product:
        """Return the sums of a view that count: numbers of pixels or weights."""
        rasterizer = self.scene.rasterizer
        if self.counts:
            return optional_products(rasterizer).sparse_class_pixel_counts
        return rasterizer.sparse_class_contributions

    def _ambiguous(self, surfels: Surfels) -> Tensor:
        """Trace all views and return the ambiguous Gaussians, [N] bool."""
        scene, options, inputs = self.scene, self.options, geometry_inputs(surfels)
        product = self._product()
        traced = tracing.InstanceTracing(len(surfels), surfels.means.device)

        def trace(view: int) -> tuple[Tensor, Tensor]:
            return product(inputs, scene.cameras[view], scene.settings, scene.labels[view], self.num_classes)

        with scene.stage("Tracing Gaussians") as progress, torch.no_grad():
            for keys, counts in each_view(len(scene.cameras), trace, progress):
                traced.add(keys, counts, self.num_classes, options.min_pixels, options.min_share)
        return traced.ambiguous(options.max_ambiguous)

    def _composited(self, edited: Densified) -> Densified:
        """Prune Gaussians that no view composites at any pixel, labelled or not."""
        scene, inputs = self.scene, geometry_inputs(edited.surfels)
        rasterizer = optional_products(scene.rasterizer)

        def trace(view: int) -> Tensor:
            camera = scene.cameras[view]
            one_class = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=inputs.means.device)
            return rasterizer.sparse_class_pixel_counts(inputs, camera, scene.settings, one_class, 1)[0]

        with scene.stage("Tracing Gaussians") as progress, torch.no_grad():
            views = each_view(len(scene.cameras), trace, progress)
            return edited.only(~tracing.never_composited(views, len(edited.surfels), inputs.means.device))
