"""The errors of training views, and the Gaussians that hold them, while the base grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.assignment.high_errors import HighErrors, held_by_error
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import geometry_inputs, surfel_inputs


@torch.no_grad()
def high_errors(model: SceneModel, datamanager: BeagsDataManager, views: Sequence[int], step: int) -> HighErrors:
    """Render training ``views`` by index as ``step`` sees them, and return what Gaussians hold of their errors."""
    found = HighErrors(model.num_points, model.device)
    surfels, background = model.surfels().detach(), model.background_color.to(model.device)
    settings = replace(model.settings(), geometry=False)
    for index in views:
        camera, batch = datamanager.training_view(index, step)
        inputs = surfel_inputs(surfels, camera, model.active_sh_degree())
        color = model.rasterizer.rasterize(inputs, camera, settings, background).color
        error = _error(color, model.truth(batch, background), batch)
        found.add(held_by_error(model.rasterizer, inputs, camera, settings, error))
    return found


@torch.no_grad()
def shown_weights(model: SceneModel, datamanager: BeagsDataManager, step: int) -> Tensor:
    """Return [N] float64, each Gaussian's sum of w_i over all pixels of all training views as ``step`` sees them."""
    inputs = geometry_inputs(model.surfels())
    found = torch.zeros(model.num_points, dtype=torch.float64, device=model.device)
    for index in range(len(datamanager.train_dataset)):
        camera = datamanager.training_camera(index, step)
        everywhere = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=model.device)
        settings = replace(model.settings(), geometry=False)
        found += model.rasterizer.class_contributions(inputs, camera, settings, everywhere, 1)[:, 0]
    return found


def _error(color: Tensor, image: Tensor, batch: dict) -> Tensor:
    """Return the mean absolute error of the channels [H, W]; 0 where the batch knows nothing of the photo."""
    error = (color - image).abs().mean(dim=-1)
    return error * batch["known"] if "known" in batch else error
