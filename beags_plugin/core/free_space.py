"""The space before each camera that is known to be empty: nearer than all points that structure from motion found."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels

NEAREST = 0.02  # share of a view's points that may be wrong, and lie too near
LEAST_POINTS = 20  # a view that shows fewer points says nothing
REACH = 2.0  # standard deviations of a Gaussian along an axis that count as its own
MARGIN = 0.1  # What stands beside a picture by this share of its width or height counts too.


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
    """Return [N] bool, which Gaussians reach into some view's picture nearer than its depth.

    Five points of each count: its centre, and both ends of its two axes at ``REACH``. surfels: N, without gradients.
    depths: [V] world units.
    """
    axes = rotation_from_quat(surfels.quats)[:, :, :2] * (REACH * surfels.log_scales.exp())[:, None]  # [N, 3, 2]
    steps = torch.stack([torch.zeros_like(surfels.means), *axes.unbind(2), *(-axes).unbind(2)], dim=1)
    size = steps.norm(dim=2).amax(dim=1)
    found = torch.zeros(len(surfels), dtype=torch.bool, device=surfels.means.device)
    for camera, depth in zip(cameras, depths.tolist(), strict=True):
        # The distance along the axis alone tells of most Gaussians that they stand further off.
        x, y, z = camera.host.rotation[2].tolist()
        means = surfels.means
        along = x * means[:, 0] + y * means[:, 1] + z * means[:, 2] + float(camera.host.translation[2])
        near = ((along + size > 0) & (along - size < depth)).nonzero()[:, 0]
        framed, z = _framed((means[near, None] + steps[near]).view(-1, 3), camera, MARGIN)
        found[near] |= (framed & (z < depth)).view(-1, 5).any(dim=1)
    return found


def _framed(points: Tensor, camera: Camera, margin: float) -> tuple[Tensor, Tensor]:
    """Return which points [P, 3] lie in a camera's picture, widened by ``margin``, [P] bool, and their depths [P]."""
    xy, z = project(points, camera)
    x, y = xy[:, 0] / camera.width, xy[:, 1] / camera.height
    return (z > 0) & (x > -margin) & (x < 1.0 + margin) & (y > -margin) & (y < 1.0 + margin), z
