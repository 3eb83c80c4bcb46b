"""The stages that python -m benchmarks.scaling measures, each as a call on a synthetic scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.assignment.assignment import assign_classes
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.boundary import BoundaryLoss
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.losses.photometric import PhotometricLoss
from beags_plugin.masks import REPROJECTIONS
from beags_plugin.occupancy.build import build_visibility_grid
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers.interface import Rasterizer, RasterOutputs, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surface_depth, surfel_inputs
from benchmarks.scaling_scene import SETTINGS, SyntheticScene
from benchmarks.training_step import Training

STEP = "refinement step"
CHANNELS = "step, a channel per class"
PAIRWISE, VOXEL = "reprojection, pairwise", "reprojection, voxel"
STAGES = (STEP, "depth", PAIRWISE, VOXEL, "assignment", "voxel grids", CHANNELS)
_K = 50  # neighbours that set the voxel size, as in the presets for small scenes
_NO_GEOMETRY = RasterSettings(SETTINGS.near, SETTINGS.far, geometry=False)
_RATE = 1e-9  # of learning: every call shall find the same scene


def stages(scene: SyntheticScene, rasterizer: Rasterizer, channels: bool) -> dict[str, Callable[[], object]]:
    """Return calls by name, and make the inputs that stages need of others. channels: also return ``CHANNELS``."""
    depths = _depths(scene, rasterizer)
    grid = _grid(scene, rasterizer)
    labels = scene.labels

    def reproject(name: str) -> Callable[[], object]:
        return lambda: list(REPROJECTIONS.get(name)(depths, scene.cameras, labels, scene.num_classes))

    calls: dict[str, Callable[[], object]] = {
        STEP: _Step(scene, rasterizer, grid),
        "depth": lambda: _depths(scene, rasterizer),
        PAIRWISE: reproject("pairwise"),
        VOXEL: reproject("voxel"),
        "assignment": lambda: assign_classes(
            scene.surfels, scene.cameras, labels, rasterizer, SETTINGS, scene.num_classes
        ),
        "voxel grids": lambda: _grid(scene, rasterizer),
    }
    if channels:
        calls[CHANNELS] = _ChannelStep(scene, rasterizer)
    return calls


def _depths(scene: SyntheticScene, rasterizer: Rasterizer) -> list[Tensor]:
    inputs = geometry_inputs(scene.surfels)
    with torch.no_grad():
        rendered = (rasterizer.rasterize(inputs, camera, SETTINGS, torch.zeros(3)) for camera in scene.cameras)
        return [surface_depth(view, "median") for view in rendered]


def _grid(scene: SyntheticScene, rasterizer: Rasterizer) -> VisibilityGrid:
    return build_visibility_grid(
        scene.surfels, scene.class_ids, scene.cameras, rasterizer, SETTINGS, scene.num_classes, _K
    )


class _Training(Training):
    """Steps of Adam on a scene, the views in turn."""

    def __init__(self, scene: SyntheticScene, rasterizer: Rasterizer) -> None:
        super().__init__(scene.surfels, _RATE)
        self.scene, self.rasterizer = scene, rasterizer

    def loss(self, view: int) -> Tensor:
        raise NotImplementedError

    def __call__(self) -> float:
        loss = self.loss(self.step % len(self.scene.cameras))
        loss.backward()
        self.adam.step()
        self.adam.zero_grad()
        self.step += 1
        return float(loss.detach())

    def losses(self, view: int, rendered: RasterOutputs, grid: VisibilityGrid | None) -> LossInputs:
        scene = self.scene
        return LossInputs(
            self.step, 0, self.surfels(), scene.cameras[view], rendered, scene.images[view], scene.labels[view],
            scene.class_ids, grid,
        )  # fmt: skip


class _Step(_Training):
    """A step of refinement with photometric, boundary and occupancy loss."""

    def __init__(self, scene: SyntheticScene, rasterizer: Rasterizer, grid: VisibilityGrid) -> None:
        super().__init__(scene, rasterizer)
        self.grid = grid

    def loss(self, view: int) -> Tensor:
        scene = self.scene
        camera = scene.cameras[view]
        inputs = surfel_inputs(self.surfels(), camera, class_ids=scene.class_ids)
        rendered = self.rasterizer.rasterize(inputs, camera, _NO_GEOMETRY, torch.zeros(3), scene.labels[view])
        found = self.losses(view, rendered, self.grid)
        terms = (PhotometricLoss(), BoundaryLoss(), OccupancyLoss())
        return sum((term.weight * term.value(found) for term in terms), torch.zeros(()))


class _ChannelStep(_Training):
    """A step of methods that learn a vector of class scores for each Gaussian.

    The scores are rendered as channels, three at a time as colours, and compared with the labels by cross-entropy.
    """

    def __init__(self, scene: SyntheticScene, rasterizer: Rasterizer) -> None:
        super().__init__(scene, rasterizer)
        self.renders = -(-scene.num_classes // 3)
        self.scores = torch.zeros(self.renders, len(scene.surfels), 3, requires_grad=True)
        self.adam.add_param_group({"params": [self.scores]})

    def loss(self, view: int) -> Tensor:
        scene = self.scene
        camera, surfels = scene.cameras[view], self.surfels()
        rendered = self._render(surfel_inputs(surfels, camera), camera)
        classes = [
            self._render(surfel_inputs(surfels, camera), camera, colors).color for colors in self.scores.unbind()
        ]
        logits = torch.cat(classes, dim=-1)[..., : scene.num_classes].reshape(-1, scene.num_classes)
        entropy = torch.nn.functional.cross_entropy(logits, scene.labels[view].reshape(-1).long())
        return PhotometricLoss().value(self.losses(view, rendered, None)) + entropy

    def _render(self, inputs, camera, colors: Tensor | None = None) -> RasterOutputs:
        inputs = inputs if colors is None else replace(inputs, colors=colors)
        return self.rasterizer.rasterize(inputs, camera, _NO_GEOMETRY, torch.zeros(3))
