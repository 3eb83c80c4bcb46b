"""Pages of a viewer that look as a view of the touching solids does, and where they show things; without a browser."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import torch
from touching_solids import views
from viser.transforms import SO3

from beags_plugin.plugin.viewer.aim import WORLD
from beags_plugin.plugin.viewer.pointing import page_camera

VIEW = views()[3]


def page(view=VIEW):
    """Return the camera of a page that looks as a view does."""
    wxyz = SO3.from_matrix(view.rotation.double().T.numpy()).wxyz
    fov = 2 * np.arctan(view.height / 2 / float(view.K[1, 1]))
    return SimpleNamespace(wxyz=wxyz, position=WORLD * view.center.double().numpy(), fov=fov, aspect=1.0)


def position(point) -> tuple[float, float]:
    """Return where the page shows a point of the world, (x, y) in 0..1."""
    camera = page_camera(page())
    x, y, z = (camera.K @ (camera.rotation @ torch.tensor(point) + camera.translation)).tolist()
    return x / z / camera.width, y / z / camera.height


def click_on(point) -> SimpleNamespace:
    """Return what a page sends of a click on a point of the world."""
    return SimpleNamespace(screen_pos=position(point), client=SimpleNamespace(camera=page()))
