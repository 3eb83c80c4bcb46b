"""Clicks and boxes on a viewer's page as marks of the cut."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.sources.cut import MARK
from beags_plugin.picking.cutter import ViewMarks
from beags_plugin.plugin.viewer.aim import WORLD
from beags_plugin.plugin.viewer.picking import camera_along
from beags_plugin.system.errors import UserError

if TYPE_CHECKING:
    from viser import CameraHandle

_NAME = "the viewer"
_DIAGONAL = 1000.0  # Pixels of a page, whatever its size, so that marks are as large as in photos.
_LEAST_SIDE = 0.01  # Share of the page; a smaller box was meant as a click.


def along(position: Sequence[float], page: Camera) -> Tensor:
    """Return the direction [3] float64, world, of a page's ray at ``position``: see ``click_mark``."""
    pixel = torch.tensor([position[0] * page.width, position[1] * page.height, 1.0], dtype=torch.float64)
    return page.rotation.double().T @ torch.linalg.solve(page.K.double(), pixel)


def click_mark(position: Sequence[float], page: Camera, inside: bool, drawn: Tensor | None) -> ViewMarks:
    """Return the mark of a click on the object, or beside it.

    position: (x, y) in 0..1 of the page; the ray that viser 0.2.7 sends with a click on a node is wrong. page: see
    ``page_camera``. drawn: see ``ViewMarks``.
    """
    direction = along(position, page)
    pixels = 2 * round(MARK * _DIAGONAL) + 1
    view = camera_along(page.center.tolist(), direction.tolist(), pixels, float(page.K[1, 1]))
    return ViewMarks(_NAME, view, torch.zeros(pixels, pixels, dtype=torch.int32), (inside,), drawn=drawn)


def box_mark(
    corners: Sequence[Sequence[float]], page: Camera, inside: bool, drawn: Tensor | None, pointing: bool
) -> ViewMarks:
    """Return the mark of a box: nothing outside of it belongs to the object, or nothing inside if ``inside`` is False.

    corners: two opposite ones, (x, y) in 0..1 of the page. pointing: whether the middle of the box is also a click on
    the object. Raises ``UserError`` for a box of hardly any size.
    """
    (left, right), (top, bottom) = (sorted(corner[axis] for corner in corners) for axis in (0, 1))
    if min(right - left, bottom - top) < _LEAST_SIDE:
        raise UserError("that was no box: press the button again, and drag over the picture.")
    column, row = np.arange(page.width) + 0.5, np.arange(page.height)[:, None] + 0.5
    left, right, top, bottom = left * page.width, right * page.width, top * page.height, bottom * page.height
    box = torch.from_numpy((column >= left) & (column <= right) & (row >= top) & (row <= bottom))
    numbers = torch.full((page.height, page.width), IGNORE, dtype=torch.int32)
    if not pointing:
        return ViewMarks(_NAME, page, numbers, (), box if inside else ~box, drawn=drawn)
    x, y, radius = int((left + right) / 2), int((top + bottom) / 2), round(MARK * _DIAGONAL)
    numbers[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1] = 0
    return ViewMarks(_NAME, page, numbers, (True,), box, drawn=drawn)


def page_camera(camera: CameraHandle) -> Camera:
    """Return a page's present camera in nerfstudio's world, for pictures of ``_DIAGONAL`` pixels."""
    from viser.transforms import SO3

    height = max(1, round(_DIAGONAL / math.hypot(1.0, camera.aspect)))
    width = max(1, round(height * camera.aspect))
    rotation = torch.from_numpy(SO3(camera.wxyz).as_matrix().T.copy())
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ torch.from_numpy(camera.position / WORLD)
    focal = height / (2 * math.tan(camera.fov / 2))
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat.float(), K, width, height)
