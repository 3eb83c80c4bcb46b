"""Random surfels, renders of them from a given eye, and how much two renders differ."""

from __future__ import annotations

import math

import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.rotations import rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs


def random_surfels(count: int = 7, degree: int = 3, dtype: torch.dtype = torch.float32) -> Surfels:
    generator = torch.Generator().manual_seed(1)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=dtype)

    return Surfels.of(
        draw(count, 3), draw(count, 4), draw(count, 2) - 3, draw(count), 0.2 * draw(count, (degree + 1) ** 2, 3)
    )


def a_rotation(seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return rotation_from_quat(torch.randn(4, generator=generator, dtype=torch.float64))


SETTINGS = RasterSettings(0.01, 100.0)


def camera_at(eye: tuple[float, float, float], target: torch.Tensor | None = None, pixels: int = 48) -> Camera:
    """Return a view of ``target`` from ``eye``, float32."""
    position = torch.tensor(eye, dtype=torch.float64)
    forward = torch.nn.functional.normalize((torch.zeros(3) if target is None else target).double() - position, dim=0)
    right = torch.linalg.cross(forward, torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64))
    right = right / right.norm()
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    K = torch.tensor([[1.2 * pixels, 0, 0.5 * pixels], [0, 1.2 * pixels, 0.45 * pixels], [0, 0, 1]])
    return Camera(viewmat.float(), K, pixels, pixels - 6)


def drawn(surfels: Surfels, camera: Camera, settings: RasterSettings = SETTINGS) -> torch.Tensor:
    with torch.no_grad():
        render = make_rasterizer("auto").rasterize(surfel_inputs(surfels, camera), camera, settings, torch.ones(3))
    return render.color


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return -10 * math.log10(max(float((a - b).square().mean()), 1e-12))
