"""The empty space before each camera: nearer than all points of structure from motion."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels

NEAREST = 0.02  # share of a view's points that may be outliers nearer than the scene
LEAST_POINTS = 20  # a view that shows fewer points bounds nothing
REACH = 2.0  # extent of a Gaussian along an axis, standard deviations
MARGIN = 0.1  # share of an image's width and height by which it is widened on each side


def nearest_depths(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Return the depth [V] at which the nearest points of each view begin, world units; 0 where nothing is known.

    points: [P, 3] world.
    """
    depths = []
    for camera in cameras:
        inside, z = _framed(points, camera, 0.0)
        depths.append(float(z[inside].quantile(NEAREST)) if int(inside.sum()) >= LEAST_POINTS else 0.0)
    return torch.tensor(depths)


def reaches_before_camera(surfels: Surfels, cameras: Sequence[Camera], depths: Tensor) -> Tensor:
    """Return [N] bool, which Gaussians lie in some view's image nearer than its depth.

    Five points of each are tested: its centre, and both ends of its two axes at ``REACH``. surfels: N, without
    gradients. depths: [V] world units.
    """
    axes = rotation_from_quat(surfels.quats)[:, :, :2] * (REACH * surfels.log_scales.exp())[:, None]  # [N, 3, 2]
    steps = torch.stack([torch.zeros_like(surfels.means), *axes.unbind(2), *(-axes).unbind(2)], dim=1)
    size = steps.norm(dim=2).amax(dim=1)
    reaches = torch.zeros(len(surfels), dtype=torch.bool, device=surfels.means.device)
    for camera, depth in zip(cameras, depths.tolist(), strict=True):
        # The depth of its centre rules out most Gaussians before any point is projected.
        x, y, z = camera.host.rotation[2].tolist()
        means = surfels.means
        along = x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + float(camera.host.translation[2])
        near = ((along + size > 0) & (along - size < depth)).nonzero()[:, 0]
        framed, z = _framed((means[near, None] + steps[near]).view(-1, 3), camera, MARGIN)
        reaches[near] |= (framed & (z < depth)).view(-1, 5).any(dim=1)
    return reaches


def _framed(points: Tensor, camera: Camera, margin: float) -> tuple[Tensor, Tensor]:
    """Return which points [P, 3] lie in a camera's image, widened by ``margin``, [P] bool, and their depths [P]."""
    xy, z = project(points, camera)
    x, y = xy[:, 0] / camera.width, xy[:, 1] / camera.height
    return (z > 0) & (x > -margin) & (x < 1.0 + margin) & (y > -margin) & (y < 1.0 + margin), z
