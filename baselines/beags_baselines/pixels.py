"""Pixels under points, and how far they move as the points do."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import pixels_of

MARGIN = 1.3


def pixels_under(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """Return the points inside the image and in front of the camera, and their pixels.

    points: [P, 3] float. Returns three tensors [S] int64: indices of the points, ascending; rows; columns.
    """
    inside, row, column, _ = pixels_of(points, camera)
    places = inside.nonzero()[:, 0]
    return places, row[places], column[places]


def project_directions(directions: Tensor, points: Tensor, camera: Camera) -> Tensor:
    """Return J W d, [P, 2] pixels: how far each point moves in the image per unit step along its direction.

    As in 3D Gaussian splatting, J is taken at the nearest point within ``MARGIN`` times the image's half width and
    height, because it grows without bound outside.

    directions, points: [P, 3] float, the points in front of the camera.
    """
    W, K = camera.rotation.to(points).T, camera.K.to(points)
    x, y, z = (_turned(points, W) + camera.translation.to(points)).unbind(-1)
    dx, dy, dz = _turned(directions, W).unbind(-1)
    reach_x, reach_y = (MARGIN * size / (2 * float(K[k, k])) for k, size in enumerate((camera.width, camera.height)))
    moved_x = (dx - (x / z).clamp(-reach_x, reach_x) * dz) / z
    moved_y = (dy - (y / z).clamp(-reach_y, reach_y) * dz) / z
    return torch.stack([K[0, 0] * moved_x + K[0, 1] * moved_y, K[1, 1] * moved_y], dim=-1)


def _turned(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return rows [..., 3] times a matrix [3, 3], the same bits on all machines, unlike a matrix product."""
    x, y, z = rows.unbind(-1)
    return torch.stack([x * matrix[0, c] + y * matrix[1, c] + z * matrix[2, c] for c in range(3)], dim=-1)
