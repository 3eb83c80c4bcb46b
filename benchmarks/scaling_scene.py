"""A scene of any size: a ball of painted patches before a backdrop, seen from all around."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers.interface import Rasterizer, RasterSettings
from beags_plugin.rasterizers.rendering import geometry_inputs, surfel_inputs

SETTINGS = RasterSettings(near=0.1, far=20.0)
_DISTANCE = 3.2  # of the cameras from the middle of the ball, whose radius is 1
_BACKDROP = 4.0  # radius of the sphere around all


@dataclass(frozen=True)
class Sizes:
    """Sizes of a scene. classes: objects, without the background; pixels: of one view (4 x 3)."""

    classes: int = 8
    views: int = 8
    gaussians: int = 10_000
    pixels: int = 19_200


@dataclass(frozen=True)
class SyntheticScene:
    """A generated scene.

    surfels: N. class_ids: [N] int32. cameras: V. images: V x [H, W, 3] in 0..1. labels: V x [H, W] int32.
    """

    surfels: Surfels
    class_ids: Tensor
    cameras: Sequence[Camera]
    images: Sequence[Tensor]
    labels: Sequence[Tensor]
    num_classes: int


def make_scene(sizes: Sizes, rasterizer: Rasterizer, seed: int = 0) -> SyntheticScene:
    """Make a ball whose patches are the classes: their number changes neither shapes nor pictures."""
    g = torch.Generator().manual_seed(seed)
    on_ball = sizes.gaussians * 3 // 4
    ball, backdrop = _sphere(on_ball), _sphere(sizes.gaussians - on_ball)
    patches = _sphere(sizes.classes)
    of_ball = torch.cat([(part @ patches.T).argmax(1) for part in ball.split(4096)]) + 1
    class_ids = torch.cat([of_ball, torch.zeros(len(backdrop), dtype=torch.int64)]).int()
    normals = torch.cat([ball, backdrop])
    radius = torch.where(class_ids > 0, 1.0, _BACKDROP)
    count = torch.where(class_ids > 0, float(on_ball), float(len(backdrop)))
    spacing = radius * (4 * math.pi / count).sqrt()
    n = sizes.gaussians
    sh = torch.cat([torch.randn(n, 1, 3, generator=g), 0.1 * torch.randn(n, 15, 3, generator=g)], dim=1)
    log_scales = (0.6 * spacing).log()[:, None].expand(n, 2).contiguous()
    surfels = Surfels.of(normals * radius[:, None], _turned(normals), log_scales, torch.full((n,), 2.0), sh)
    height = round(math.sqrt(sizes.pixels * 3 / 4))
    cameras = [_camera(i, sizes.views, round(height * 4 / 3), height) for i in range(sizes.views)]
    images, labels = [], []
    with torch.no_grad():
        for camera in cameras:
            rendered = rasterizer.rasterize(surfel_inputs(surfels, camera), camera, SETTINGS, torch.zeros(3))
            images.append(0.9 * rendered.color.clamp(0, 1) + 0.05)  # differs from the render, to leave a loss
            inputs = geometry_inputs(surfels, class_ids)
            labels.append(rasterizer.class_map(inputs, camera, SETTINGS, sizes.classes + 1)[0])
    return SyntheticScene(surfels, class_ids, cameras, images, labels, sizes.classes + 1)


def _sphere(count: int) -> Tensor:
    """Return [count, 3] float32 unit vectors, evenly spread (a Fibonacci spiral)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / max(count, 1)
    angle = math.pi * (1 + math.sqrt(5)) * i
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=1).float()


def _turned(normals: Tensor) -> Tensor:
    """Return [N, 4] wxyz quaternions that turn the z axis to the normals [N, 3]."""
    x, y, z = normals.unbind(1)
    return torch.stack([(1 + z).clamp_min(1e-4), -y, x, torch.zeros_like(x)], dim=1)


def _camera(index: int, count: int, width: int, height: int) -> Camera:
    """Return a camera of a ring that looks at the middle; every other one from above."""
    turn, rise = 2 * math.pi * index / count, 0.5 * (index % 2)
    center = _DISTANCE * torch.tensor(
        [math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)], dtype=torch.float64
    )
    forward = -center / center.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    right = right / right.norm()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    K = torch.tensor([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]], dtype=torch.float32)
    return Camera(viewmat.float(), K, width, height)
