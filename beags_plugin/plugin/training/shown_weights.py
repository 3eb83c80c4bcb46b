"""What training views show of each Gaussian, while the base grows."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import geometry_inputs


@torch.no_grad()
def shown_weights(model: SceneModel, datamanager: BeagsDataManager, step: int) -> Tensor:
    """Return [N] float64, each Gaussian's sum of w_i over all pixels of all training views as ``step`` sees them."""
    inputs, settings = geometry_inputs(model.surfels()), replace(model.settings(), geometry=False)
    found = torch.zeros(model.num_points, dtype=torch.float64, device=model.device)
    for index in range(len(datamanager.train_dataset)):
        camera = datamanager.training_camera(index, step)
        everywhere = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=model.device)
        found += model.rasterizer.class_contributions(inputs, camera, settings, everywhere, 1)[:, 0]
    return found
