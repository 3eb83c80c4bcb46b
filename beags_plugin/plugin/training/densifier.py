"""Growth of the base while it trains: densification and opacity resets (method, section 1)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.optim import Adam

from beags_plugin.core.cameras import Camera
from beags_plugin.core.densification import (
    Densified,
    GradientStatistics,
    bounded,
    densify,
    frees_at,
    grows_at,
    length_units,
    reset_opacity,
    resets_at,
    scaled,
)
from beags_plugin.core.free_space import nearest_depths, reaches_before_camera
from beags_plugin.plugin.training.near_growth import MaskedPhotos, on_objects, shared_pixels
from beags_plugin.plugin.training.scene_edits import edit_scene, move_adam_state
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.system.progress import say

MOST_FREED = 0.2  # Largest share of Gaussians to remove: with more, seed points are too few to bound near surfaces.


class Densifier:
    """Grows and prunes the base by gathered screen gradients and by free space before cameras."""

    def __init__(self, model: SceneModel, adam: Adam, datamanager: BeagsDataManager) -> None:
        self.model = model
        self.datamanager = datamanager
        cameras = datamanager.train_dataset.cameras
        self.camera_centers = cameras.camera_to_worlds[:, :3, 3]  # [V, 3] world
        pixels = int((cameras.height * cameras.width).sum())  # Pixels of all whole training images.
        stated, close_ups = scaled(model.config.densify, model.schedule.scale), datamanager.close_ups
        of_objects, elsewhere = (0, pixels) if close_ups is None else shared_pixels(pixels, close_ups.object_pixels())
        self.config, self.most_near = bounded(stated, elsewhere), bounded(stated, of_objects).max_surfels
        self.photos: MaskedPhotos | None = None
        if close_ups is not None:
            with_objects = sorted({each.photo for each in close_ups.close_ups})
            self.photos = MaskedPhotos.of(datamanager.views("train", original=True), with_objects)
        self.adam = adam
        self.statistics = GradientStatistics(model.num_points, model.device)
        self.free = self._free_depths()

    def state(self) -> dict[str, Any]:
        """Return the statistics since the last growth, and whether space before cameras is freed; see ``Resumable``."""
        statistics = self.statistics if self.model.growing else GradientStatistics(0)
        return {"total": statistics.total, "views": statistics.views, "frees": self.free is not None}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue from ``state``."""
        if not state["frees"]:
            self.free = None
        if len(state["total"]) == self.model.num_points:
            own = self.statistics
            own.total, own.views = state["total"].clone().to(own.total), state["views"].clone().to(own.views)

    def before_step(self, step: int) -> None:
        """Turn on screen gradients for the step if the scene still grows."""
        model, schedule = self.model, self.model.schedule
        model.growing = not schedule.warm and step + 1 < min(self.config.stop, schedule.base_steps)

    def after_step(self, step: int) -> None:
        """Gather statistics; densify, free the space before cameras and reset opacities at their steps."""
        config, schedule, done = self.config, self.model.schedule, step + 1
        growing = self.model.growing and self.model.last_render is not None
        if growing:
            self._gather()
            if grows_at(config, done):
                self._densify(done)
        if not schedule.warm and frees_at(config, done, schedule.base_steps):
            self._free_cameras()
        if growing and resets_at(config, done):
            self._reset_opacity()

    def _gather(self) -> None:
        last = self.model.last_render
        if last is not None and last.screen_shift is not None and last.screen_shift.grad is not None:
            gradient, visible = last.screen_shift.grad.norm(dim=-1), last.render.visible
            if last.close_up and last.labels is not None:
                visible = visible & on_objects(self.model.surfels().means.detach(), last.camera, last.labels)
            self.statistics.add(gradient, visible)

    def _densify(self, step: int) -> None:
        model = self.model
        surfels = model.surfels().detach()
        units = length_units(surfels.means, self.camera_centers, float(model.extent), self.config)
        apart = None if self.photos is None else (self.photos.near(surfels.means), self.most_near)
        gradient = self.statistics.mean()
        self._edit(densify(surfels, gradient, units, self.config, step, model.generator(step), apart))

    def _free_cameras(self) -> None:
        """Remove Gaussians in the free space before a camera, whose photo shows surfaces further away.

        If they are many, nothing is removed from here on: near surfaces may be smooth and have no seed points.
        """
        if self.free is None:
            return
        surfels = self.model.surfels().detach()
        before = reaches_before_camera(surfels, *self.free)
        share = float(before.float().mean())
        if share > MOST_FREED:
            self.free = None
            say(f"{share:.0%} of the Gaussians stand nearer to a camera than the seed points it shows: they are kept.")
        elif share > 0.0:
            self._edit(Densified.unchanged(surfels).only(~before), keep_statistics=True)

    def _free_depths(self) -> tuple[list[Camera], Tensor] | None:
        """Return the training cameras and the depth up to which the space before each is free; None if unknown."""
        if self.config.free_share == 0.0:
            return None
        metadata = self.datamanager.train_dataparser_outputs.metadata
        if metadata["points3D_random"]:
            return None
        cameras = [view.camera for view in self.datamanager.views("train")]
        points = metadata["points3D_xyz"].to(self.model.device)
        return cameras, self.config.free_share * nearest_depths(points, cameras)

    def _edit(self, edited: Densified, keep_statistics: bool = False) -> None:
        model, gathered = self.model, self.statistics
        edit_scene(model, self.adam, edited)
        self.statistics = GradientStatistics(model.num_points, model.device)
        if keep_statistics:
            self.statistics.total, self.statistics.views = (
                values[edited.source] for values in (gathered.total, gathered.views)
            )
        model.last_render = None

    def _reset_opacity(self) -> None:
        model = self.model
        logits = reset_opacity(model.surfels().detach())
        parameter = model.gauss_params["opacities"]
        parameter.data = logits[:, None].contiguous()
        index = torch.arange(logits.shape[0])
        move_adam_state(self.adam, parameter, parameter, index, torch.ones_like(index, dtype=torch.bool))
