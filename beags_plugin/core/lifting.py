"""Convert pixels with a depth to points in the world, and back (method, sections 0 and 2)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera

Depths = TypeVar("Depths", Tensor, np.ndarray)
TAU = 0.02
"""Depths that differ by at most this share lie on one surface; a surface nearer by more hides it (method, E5)."""


def hides(surface: Depths, depth: Depths) -> Depths:
    """Return where a surface hides what lies at ``depth`` along the same ray: where it is nearer by more than ``TAU``.

    surface: depths of any shape, 0 where there is none, which hides nothing. depth: the same shape, Tensor or array.
    Returns booleans.
    """
    return (surface > 0) & (surface < (1.0 - TAU) * depth)  # type: ignore[return-value]  # numpy's operators


def pixel_rays(camera: Camera, like: Tensor) -> Tensor:
    """Return camera-space points at depth 1 under the pixel centres: K^-1 (i + 0.5, j + 0.5, 1).

    like: any tensor, whose dtype and device the result has. Returns [H, W, 3]; the last component is 1.
    """
    K = camera.K.to(like)
    x = torch.arange(camera.width, dtype=like.dtype, device=like.device) + 0.5
    y = torch.arange(camera.height, dtype=like.dtype, device=like.device) + 0.5
    ray_y = (y - K[1, 2]) / K[1, 1]
    ray_x = (x[None, :] - K[0, 2] - K[0, 1] * ray_y[:, None]) / K[0, 0]  # K[0, 1] is the skew, mostly 0
    return torch.stack([ray_x, ray_y[:, None].expand_as(ray_x), torch.ones_like(ray_x)], dim=-1)


def lift(depth: Tensor, camera: Camera) -> Tensor:
    """Return the world point of every pixel of a view.

    depth: [H, W] float, world units along z (not along the ray). Returns [H, W, 3] of the same dtype; a pixel without
    depth (0) gives the camera's position. Raises ``ValueError`` if the depth has another size than the camera.
    """
    if tuple(depth.shape) != (camera.height, camera.width):
        raise ValueError(f"depth must be [{camera.height}, {camera.width}], not {list(depth.shape)}")
    points = pixel_rays(camera, depth) * depth[..., None] - camera.translation.to(depth)
    return _times(points, camera.rotation.to(depth))  # rows times W = W^T (x - t)


def project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return pixel coordinates and depths of world points.

    points: [P, 3] float. Returns xy [P, 2] in pixels and z [P] in world units along z, both of the same dtype. xy has a
    meaning only where z > 0, and is not finite at z = 0.
    """
    in_camera = _times(points, camera.rotation.to(points).T) + camera.translation.to(points)
    homogeneous = _times(in_camera, camera.K.to(points).T)
    z = in_camera[..., 2]
    return homogeneous[..., :2] / z[..., None], z


def pixels_of(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return which points lie inside the image and in front of the camera, and the pixels and depths of all.

    points: [P, 3] float. Returns inside [P] bool; rows and columns [P] int64, any in the image where not inside; z [P].
    """
    xy, z = project(points, camera)
    limit = torch.tensor([camera.width, camera.height], device=xy.device)
    inside = (z > 0) & ((xy >= 0) & (xy < limit)).all(dim=-1)
    column, row = xy.nan_to_num().floor().long().clamp(min=0).minimum(limit - 1).unbind(dim=-1)
    return inside, row, column, z


def _times(rows: Tensor, matrix: Tensor) -> Tensor:
    """Return rows [..., 3] times a matrix [3, 3].

    Determinism: the matrix product of a library may differ between machines and numbers of threads.
    """
    x, y, z = rows.unbind(-1)
    return torch.stack([x * matrix[0, c] + y * matrix[1, c] + z * matrix[2, c] for c in range(3)], dim=-1)
