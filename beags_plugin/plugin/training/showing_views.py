"""How many training views show each Gaussian, while the base trains."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import geometry_inputs

SHOWN = 1.0  # a view shows a Gaussian whose w_i over its pixels add up to so many pixels


@torch.no_grad()
def showing_views(model: SceneModel, datamanager: BeagsDataManager, step: int) -> Tensor:
    """Return [N] int64, how many training views show each Gaussian; all are rendered, as ``step`` sees them."""
    inputs, settings = geometry_inputs(model.surfels()), replace(model.settings(), geometry=False)
    views = torch.zeros(model.num_points, dtype=torch.int64, device=model.device)
    for index in range(len(datamanager.train_dataset)):
        camera = datamanager.training_camera(index, step)
        everywhere = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=model.device)
        views += model.rasterizer.class_contributions(inputs, camera, settings, everywhere, 1)[:, 0] >= SHOWN
    return views
