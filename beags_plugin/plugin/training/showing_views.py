"""How many training views show each Gaussian and have it in their frame, while the base trains."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from beags_plugin.core.lifting import pixels_under
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.views.datamanager import BeagsDataManager
from beags_plugin.rasterizers.rendering import geometry_inputs

SHOWN = 1.0  # a view shows a Gaussian whose w_i over its pixels add up to so many pixels


@torch.no_grad()
def showing_views(model: SceneModel, datamanager: BeagsDataManager, step: int) -> tuple[Tensor, Tensor]:
    """Return how many training views show each Gaussian and how many have its centre in their frame, [N] int64 each.

    A Gaussian that others hide, such as the inside of a thing, is in frames that do not show it. All views are
    rendered, as ``step`` sees them.
    """
    surfels = model.surfels()
    inputs, settings = geometry_inputs(surfels), replace(model.settings(), geometry=False)
    showing, framing = torch.zeros(2, model.num_points, dtype=torch.int64, device=model.device)
    for index in range(len(datamanager.train_dataset)):
        camera = datamanager.training_camera(index, step)
        everywhere = torch.zeros(camera.height, camera.width, dtype=torch.int32, device=model.device)
        showing += model.rasterizer.class_contributions(inputs, camera, settings, everywhere, 1)[:, 0] >= SHOWN
        framing[pixels_under(surfels.means, camera)[0]] += 1
    return showing, framing
