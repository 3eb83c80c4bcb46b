"""nerfstudio's normalisation of poses, step by step, as the bits of training depend on it.

A test compares it with nerfstudio's ``auto_orient_and_center_poses``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def oriented(poses: Tensor, method: str, centred: bool) -> tuple[Tensor, Tensor]:
    """Turn and centre poses [V, 4, 4] float32; return them [V, 3, 4], and the transform [3, 4] applied.

    method: pca, up, vertical or none; raises ``ValueError`` for another. centred: on the cameras' middle.
    """
    origins = poses[:, :3, 3]
    middle = torch.mean(origins, dim=0)
    translation = middle if centred else torch.zeros(3)
    if method == "none":
        transform = torch.eye(4)
        transform[:3, 3] = -translation
        transform = transform[:3, :]
        return transform @ poses, transform
    if method == "pca":
        return _by_principal_axes(poses, origins - middle, translation)
    if method not in ("up", "vertical"):
        raise ValueError(f"unknown method {method!r}")
    rotation = _rotation_between(_up(poses, vertical=method == "vertical"), torch.tensor([0.0, 0.0, 1.0]))
    transform = torch.cat([rotation, rotation @ -translation[..., None]], dim=-1)
    return transform @ poses, transform


def _by_principal_axes(poses: Tensor, from_middle: Tensor, translation: Tensor) -> tuple[Tensor, Tensor]:
    _, axes = torch.linalg.eigh(from_middle.T @ from_middle)
    axes = torch.flip(axes, dims=(-1,))
    if torch.linalg.det(axes) < 0:
        axes[:, 2] = -axes[:, 2]
    transform = torch.cat([axes, axes @ -translation[..., None]], dim=-1)
    turned = transform @ poses
    if turned.mean(dim=0)[2, 1] < 0:
        turned[1:3, :] = -1 * turned[1:3, :]
        transform[1:3, :] = -1 * transform[1:3, :]
    return turned, transform


def _up(poses: Tensor, vertical: bool) -> Tensor:
    """Return the mean up of the cameras [3]; vertical: the direction that projects closest to their y axes."""
    up = torch.mean(poses[:, :3, 1], dim=0)
    up = up / torch.linalg.norm(up)
    if not vertical:
        return up
    # The up direction minimises ||X u|| for ||u|| = 1, with X the cameras' x axes: it is the last right singular
    # vector. If the second singular value says that the x axes lie on a line, it is the mean up without its part
    # along that line.
    _, values, axes = torch.linalg.svd(poses[:, :3, 0], full_matrices=False)
    if values[1] > 0.17 * math.sqrt(poses.shape[0]):
        return axes[2, :] if torch.dot(axes[2, :], up) > 0 else -axes[2, :]
    up = up - axes[0, :] * torch.dot(up, axes[0, :])
    return up / torch.linalg.norm(up)


def _rotation_between(first: Tensor, second: Tensor) -> Tensor:
    """Return the rotation [3, 3] that turns one direction [3] to another, by Rodrigues' formula."""
    first, second = first / torch.linalg.norm(first), second / torch.linalg.norm(second)
    axis = torch.linalg.cross(first, second)
    if torch.sum(torch.abs(axis)) < 1e-6:  # parallel: take any perpendicular axis
        other = torch.tensor([1.0, 0.0, 0.0]) if abs(first[0]) < 1e-6 else torch.tensor([0.0, 1.0, 0.0])
        axis = torch.linalg.cross(first, other)
    axis = axis / torch.linalg.norm(axis)
    cross = torch.tensor([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    angle = torch.acos(torch.clip(torch.dot(first, second), -1, 1))
    return torch.eye(3) + torch.sin(angle) * cross + (1 - torch.cos(angle)) * (cross @ cross)
