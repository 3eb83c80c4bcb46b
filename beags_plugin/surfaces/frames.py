"""The frame of exported files: the input's world, or the same centred on the object."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.splat_io.frames import to_input_frame
from beags_plugin.surfaces.item import Viewpoints

_BULK = 0.01  # share of the Gaussians at each side that the size of the item leaves out, because some are strays
_FENCE = 0.5  # distance beyond the bulk, over its longest side, within which thin parts still count


@dataclass(frozen=True)
class Frame:
    """The frame of x, where the run's frame is x' = scale (R x + t).

    transform: [3, 4] float64, R | t, R a rotation; scale: positive.
    """

    transform: Tensor
    scale: float

    @classmethod
    def of_run(cls) -> Frame:
        """Return the run's own frame."""
        return cls(torch.eye(4, dtype=torch.float64)[:3], 1.0)

    def centred(self, center: Tensor) -> Frame:
        """Return this frame moved so that ``center`` [3], a point of it, becomes the origin."""
        rotation, shift = self.transform[:, :3], self.transform[:, 3:]
        return replace(self, transform=torch.cat([rotation, shift + rotation @ center.double()[:, None]], dim=1))

    def turned(self, rotation: Tensor) -> Frame:
        """Return this frame turned: its x becomes ``rotation`` [3, 3] x."""
        turned, shift = self.transform[:, :3] @ rotation.double().T, self.transform[:, 3:]
        return replace(self, transform=torch.cat([turned, shift], dim=1))

    def scaled(self, factor: float) -> Frame:
        """Return this frame in other units: its x becomes ``factor`` x."""
        transform = torch.cat([self.transform[:, :3], factor * self.transform[:, 3:]], dim=1)
        return Frame(transform, self.scale / factor)

    def points(self, points: Tensor) -> Tensor:
        """Return points [P, 3] float64 of the run's frame in this one."""
        return (points / self.scale - self.transform[:, 3]) @ self.transform[:, :3]

    def surfels(self, surfels: Surfels) -> Surfels:
        """Return Gaussians of the run's frame in this one."""
        return to_input_frame(surfels, self.transform, self.scale)

    def camera(self, camera: Camera) -> Camera:
        """Return a camera of the run's frame in this one: it sees the same, with depths divided by ``scale``."""
        viewmat, rotation, shift = camera.viewmat.double(), self.transform[:, :3], self.transform[:, 3]
        moved = viewmat.clone()
        moved[:3, :3] = viewmat[:3, :3] @ rotation
        moved[:3, 3] = viewmat[:3, :3] @ shift + viewmat[:3, 3] / self.scale
        return replace(camera, viewmat=moved.to(camera.viewmat.dtype))

    def views(self, views: Viewpoints) -> Viewpoints:
        """Return viewpoints of the run's frame in this one."""
        settings = replace(views.settings, near=views.settings.near / self.scale, far=views.settings.far / self.scale)
        return Viewpoints([self.camera(camera) for camera in views.cameras], views.rasterizer, settings)

    def in_run(self, points: Tensor) -> Tensor:
        """Return points [P, 3] float64 of this frame in the run's."""
        return self.scale * (points @ self.transform[:, :3].T + self.transform[:, 3])

    def to_run(self) -> list[list[float]]:
        """Return the 4 x 4 matrix that takes points of this frame to the run's."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3] = self.scale * self.transform.double()
        return matrix.tolist()


def bounding_box(surfels: Surfels) -> tuple[Tensor, Tensor]:
    """Return the box of N Gaussians' ellipses of one standard deviation, without strays far from the others.

    It reaches at most half the bulk's longest side beyond the bulk, which leaves out 1 % at each side. Gaussians that
    are not finite do not count; without any, the box is the origin. Returns (low [3], high [3]) float64, in its frame.
    """
    axes = rotation_from_quat(surfels.quats.detach().double())[:, :, :2]
    # A disc's reach along a world axis is the length of its two half axes' components there.
    reach = (axes * surfels.log_scales.detach().double().exp()[:, None, :]).square().sum(dim=2).sqrt()
    means = surfels.means.detach().double()
    low, high = (means - reach).cpu().numpy(), (means + reach).cpu().numpy()
    finite = np.isfinite(low).all(axis=1) & np.isfinite(high).all(axis=1)
    if not finite.any():
        return torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    low, high = low[finite], high[finite]
    bulk_low, bulk_high = np.quantile(low, _BULK, axis=0), np.quantile(high, 1.0 - _BULK, axis=0)
    fence = _FENCE * (bulk_high - bulk_low).max()
    middle = (low + high) / 2
    near = ((middle >= bulk_low - fence) & (middle <= bulk_high + fence)).all(axis=1)
    return (
        torch.from_numpy(np.maximum(low[near].min(axis=0), bulk_low - fence)),
        torch.from_numpy(np.minimum(high[near].max(axis=0), bulk_high + fence)),
    )
