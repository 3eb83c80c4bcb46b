"""Chunks of space, counted one after the other to bound the memory of voxels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.masks.pooled_votes import LOOKS, lift
from beags_plugin.ops import extension
from beags_plugin.ops.voxel_votes import brick_sample

MOST_BRICKS = 1 << 19  # bricks of 4 x 4 x 4 voxels in memory: about 0.4 GB
_BRICK = 4
_PART = 64  # one brick in so many is counted, approximately
_PRIMES = (73856093, 19349663, 83492791)  # the hash of native/ops/voxel_votes.cpp


@dataclass(frozen=True)
class SpatialChunks:
    """Chunks of space: chunk s holds coordinates borders[s] .. borders[s + 1] along ``axis``, in voxels.

    borders: the first is -inf, the last inf. margin: distance of the farthest voxels read around a point, in voxels.
    """

    axis: int
    borders: tuple[float, ...]
    margin: float

    def __len__(self) -> int:
        return len(self.borders) - 1

    def coordinates(self, depth: Tensor, to_voxels: Tensor) -> Tensor:
        """Return the coordinates of a view's points along the axis, [H, W]; NaN without depth.

        to_voxels: [13] like ``depth``, see ``ops.voxel_votes``.
        """
        height, width = depth.shape
        x = torch.arange(width, dtype=depth.dtype, device=depth.device) + 0.5
        y = torch.arange(height, dtype=depth.dtype, device=depth.device)[:, None] + 0.5
        across, down, rest = to_voxels[3 * self.axis : 3 * self.axis + 3]
        coordinates = (across * x + (down * y + rest)).mul_(depth).add_(to_voxels[9 + self.axis])
        return coordinates.masked_fill_(~(depth > 0), math.nan)

    def inside(self, coordinates: Tensor, chunk: int) -> Tensor:
        """Return which points lie in the chunk, [H, W] bool."""
        return (coordinates >= self.borders[chunk]) & (coordinates < self.borders[chunk + 1])

    def about(self, coordinates: Tensor, chunk: int) -> Tensor:
        """Return which points cast votes that the chunk reads, [H, W] bool."""
        first, last = self.borders[chunk] - self.margin, self.borders[chunk + 1] + self.margin
        return (coordinates >= first) & (coordinates < last)


WHOLE = SpatialChunks(0, (-math.inf, math.inf), 0.0)


def divide_space(
    depths: Sequence[Tensor], cameras: Sequence[Camera], to_voxels: Tensor, most: int | None = None
) -> SpatialChunks:
    """Cut space along its longest axis into chunks of about ``most`` (``MOST_BRICKS``) bricks of voxels.

    depths: V x [H, W], read once, one view at a time. to_voxels: [V, 13] float64, see ``ops.voxel_votes``.
    The number of bricks is estimated from a 64th of them, which is kept in memory for each view.
    """
    most = MOST_BRICKS if most is None else most
    if sum(camera.height * camera.width for camera in cameras) <= most:
        return WHOLE
    samples = [
        (brick_sample if extension.supports(depth) else torch_brick_sample)(depth, own.to(depth), _PART)
        for depth, own in zip(depths, to_voxels, strict=True)
    ]
    bricks = torch.unique(torch.cat(samples), dim=0)
    count = -(-_PART * len(bricks) // most)
    if count <= 1:
        return WHOLE
    middle = torch.quantile(bricks.double(), torch.tensor([0.05, 0.95], dtype=torch.float64), dim=0)
    axis = int((middle[1] - middle[0]).argmax())
    along = bricks[:, axis].sort().values
    inner = sorted({int(along[len(along) * s // count]) * _BRICK for s in range(1, count)})
    return SpatialChunks(axis, (-math.inf, *map(float, inner), math.inf), _margin(cameras))


def torch_brick_sample(depth: Tensor, to_voxels: Tensor, part: int) -> Tensor:
    """Return about one in ``part`` of the bricks that hold points of a view, [M, 3] int64, sorted, on the CPU.

    Every view chooses the same bricks. depth: [H, W]. to_voxels: [13] like ``depth``, see ``ops.voxel_votes``. part: a
    power of two.
    """
    points, _, near = lift(depth, to_voxels)
    bricks = torch.floor(points[near] / _BRICK).int()
    x, y, z = (bricks * torch.tensor(_PRIMES, dtype=torch.int32, device=bricks.device)).unbind(1)  # int32 wraps around
    return torch.unique(bricks[((x ^ y ^ z) >> 8) % part == 0], dim=0).long().cpu()


def _margin(cameras: Sequence[Camera]) -> float:
    """Return ``SpatialChunks.margin``: steps along rays are longest in the corners of images."""
    longest = 1.0
    for camera in cameras:
        corners = [(x, y, 1.0) for x in (0, camera.width) for y in (0, camera.height)]
        middle = (camera.width / 2, camera.height / 2, 1.0)
        pixels = torch.tensor([*corners, middle], dtype=torch.float64)
        rays = (pixels @ torch.linalg.inv(camera.K.cpu().double()).T).norm(dim=1)
        longest = max(longest, float(rays.max() / rays[-1]))
    return math.ceil(max(abs(step) for step in LOOKS) * longest) + 3.0
