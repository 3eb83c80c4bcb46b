"""A training step without nerfstudio: SH colours, rendering, losses, backward, Adam."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import reduce

import torch

from beags_benchmarks.kernels.clock import Seconds
from beags_benchmarks.kernels.scenes import CLASSES, Scene
from beags_plugin.core.surfels import Surfels
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.boundary import BoundaryLoss
from beags_plugin.losses.normal import NormalConsistencyLoss
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.losses.photometric import PhotometricLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, SurfelInputs
from beags_plugin.rasterizers.rendering import surfel_inputs

VOXELS_PER_SPACING = 0.6  # voxel size over the mean spacing of surfels, at which a fifth of them are sampled
_OUTPUTS = ("color", "alpha", "depth", "normal", "boundary")  # inputs of the losses


class TrainingStep:
    """The step of the preset ``beags-paper`` on one scene: L1 + SSIM and normal losses; in refinement two more.

    samples: Z of the occupancy loss, in a refinement step with boundary and occupancy losses; None: a base step.
    rasterizer: the best available one if None.
    """

    def __init__(self, scene: Scene, samples: int | None = None, rasterizer: Rasterizer | None = None) -> None:
        surfels = {field.name: getattr(scene.surfels, field.name) for field in fields(Surfels)}
        self.parameters = {name: torch.nn.Parameter(value.clone().contiguous()) for name, value in surfels.items()}
        groups = [{"params": [value]} for value in self.parameters.values()]
        self.adam = torch.optim.Adam(groups, lr=0.0, eps=1e-15, fused=True)  # all steps do the same work at a rate of 0
        self.step = 0
        self.scene = scene
        self.rasterizer = rasterizer or make_rasterizer("auto")
        self.settings = replace(scene.settings, distortion=False)  # the preset's weight of the distortion is 0
        self.refining = samples is not None
        self.losses: dict[str, Loss] = {"photometric loss": PhotometricLoss(), "normal loss": NormalConsistencyLoss()}
        self.losses["normal loss"] = replace(self.losses["normal loss"], start=0, weight=0.05)
        if samples is not None:
            self.losses["boundary loss"] = BoundaryLoss()
            self.losses["occupancy loss"] = OccupancyLoss(samples=samples)
        self.grid = visibility_grid(scene) if self.refining else None

    def run(self) -> Seconds:
        """Run a step and return its time."""
        start = Seconds.now()
        self.adam.zero_grad()
        surfels = Surfels(**self.parameters)
        class_ids = self.scene.class_ids if self.refining else None
        render = self._rasterize(surfel_inputs(surfels, self.scene.camera, class_ids=class_ids))
        inputs = self._loss_inputs(surfels, render)
        # The sum has the order of nerfstudio.
        reduce(torch.add, [loss.weighted(inputs) for loss in self.losses.values()]).backward()
        self.adam.step()
        self.step += 1
        return Seconds.now() - start

    def run_parts(self) -> dict[str, Seconds]:
        """Run a step with its graph cut between parts; return the time of each; a loss's has forward and backward."""
        seconds: dict[str, Seconds] = {}
        clock = Seconds.now()

        def stop(part: str) -> None:
            nonlocal clock
            seconds[part] = Seconds.now() - clock
            clock = Seconds.now()

        self.adam.zero_grad()
        surfels = Surfels(**self.parameters)
        class_ids = self.scene.class_ids if self.refining else None
        inputs = surfel_inputs(surfels, self.scene.camera, class_ids=class_ids)
        stop("SH colours")
        names = ("means", "quats", "log_scales", "opacity_logits", "colors")
        cut = replace(inputs, **{name: getattr(inputs, name).detach().requires_grad_() for name in names})
        clock = Seconds.now()
        render = self._rasterize(cut)
        stop("rasterizer forward")
        images = {name: getattr(render, name) for name in _OUTPUTS if getattr(render, name) is not None}
        leaves = {name: image.detach().requires_grad_() for name, image in images.items()}
        loss_inputs = self._loss_inputs(surfels, replace(render, **leaves))
        for name, loss in self.losses.items():
            clock = Seconds.now()
            loss.weighted(loss_inputs).backward()
            stop(name)
        towards = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
        clock = Seconds.now()
        torch.autograd.backward([images[name] for name in towards], list(towards.values()))
        stop("rasterizer backward")
        torch.autograd.backward([getattr(inputs, name) for name in names], [getattr(cut, name).grad for name in names])
        stop("rest of the backward")
        self.adam.step()
        stop("Adam")
        self.step += 1
        return seconds

    def sampled_share(self) -> float:
        """Return the share of surfels that lie partly outside valid voxels, which the occupancy loss samples."""
        from beags_plugin.losses import occupancy

        if self.grid is None or not hasattr(occupancy, "_outside"):
            return float("nan")
        s = self.scene.surfels
        chosen = occupancy._outside(s.means, s.quats, s.log_scales, s.opacity_logits, self.scene.class_ids, self.grid)
        return len(chosen) / len(s)

    def _rasterize(self, inputs: SurfelInputs) -> RasterOutputs:
        target = self.scene.target if self.refining else None
        return self.rasterizer.rasterize(inputs, self.scene.camera, self.settings, self.scene.background, target)

    def _loss_inputs(self, surfels: Surfels, render: RasterOutputs) -> LossInputs:
        return LossInputs(
            step=self.step,
            seed=0,
            surfels=surfels,
            camera=self.scene.camera,
            render=render,
            image=self.scene.image,
            labels=self.scene.target,
            class_ids=self.scene.class_ids,
            grid=self.grid,
        )


def visibility_grid(scene: Scene) -> VisibilityGrid:
    """Return voxels around the surfels' own centres: most surfels lie in valid ones, as in a well-trained scene."""
    means = scene.surfels.means
    extent = means.amax(dim=0) - means.amin(dim=0) + 1e-3
    spacing = float((extent.prod() / len(means)) ** (1 / 3))
    return VisibilityGrid.from_points(
        [(means, scene.class_ids)], VOXELS_PER_SPACING * spacing, means.amin(dim=0).double(), CLASSES
    )
