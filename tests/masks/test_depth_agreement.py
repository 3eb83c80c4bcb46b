"""Disagreement of depths between neighbouring views, against loops and known noise."""

from __future__ import annotations

import math

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.masks.voxel_reprojection import disagreement

WIDTH, HEIGHT, FOCAL = 24, 18, 30.0
PLACES = (0.0, 0.153, 0.251, 0.317)  # x of the cameras
NEIGHBOURS = (1, 2, 3, 2)


def views(count: int = 4) -> tuple[list[torch.Tensor], list[Camera]]:
    """Cameras in a row that look at the plane z = 0.2 x + 4, and its exact depth."""
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], dtype=torch.float64)
    cameras, depths = [], []
    for place in PLACES[:count]:
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3] = -place
        camera = Camera(viewmat, K, WIDTH, HEIGHT)
        rays = lift(torch.ones(HEIGHT, WIDTH, dtype=torch.float64), camera) - camera.center
        depths.append((4 + 0.2 * camera.center[0]) / (1 - 0.2 * rays[..., 0]))
        cameras.append(camera)
    return depths, cameras


def by_loops(depths, cameras, tau: float) -> list[float]:
    """Return the disagreement of every pixel whose point its neighbour sees, in ascending order."""
    found = []
    for depth, camera, j in zip(depths, cameras, NEIGHBOURS, strict=True):
        points = lift(depth, camera).view(-1, 3) - cameras[j].center  # the cameras are not turned
        for (x, y, z), d in zip(points.tolist(), depth.view(-1).tolist(), strict=True):
            if d == 0:
                continue
            column, row = (math.floor(FOCAL * v / z + size / 2) for v, size in ((x, WIDTH), (y, HEIGHT)))
            if 0 <= column < WIDTH and 0 <= row < HEIGHT:
                error = abs(z - depths[j][row, column].item())
                found += [error * FOCAL / z] if error <= tau * z else []
    return sorted(found)


@pytest.mark.parametrize("tau", [0.02, math.inf])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_it_is_what_loops_over_pixels_find(tau, noise):
    depths, cameras = views()
    g = torch.Generator().manual_seed(0)
    depths = [depth + noise * torch.randn(depth.shape, generator=g, dtype=torch.float64) for depth in depths]
    depths[1][:5] = 0.0
    expected = torch.tensor(by_loops(depths, cameras, tau))
    assert len(expected) > 900
    for share in (0.5, 0.95):
        found = disagreement(depths, cameras, tau, share)
        assert found == pytest.approx(float(expected.quantile(share)), rel=1e-5)


def test_noise_shows_and_the_scale_of_the_scene_does_not():
    depths, cameras = views()
    g = torch.Generator().manual_seed(1)
    noisy = [depth + 0.05 * torch.randn(depth.shape, generator=g, dtype=torch.float64) for depth in depths]
    exact, wrong = (disagreement(d, cameras, math.inf, 0.95) for d in (depths, noisy))
    assert exact is not None and wrong is not None
    assert exact < 0.2  # half a pixel's width on a plane that leans by 0.2
    sigma = 0.05 * math.sqrt(2) * FOCAL / 4  # deviation of the difference of two depths, in pixels
    assert 1.6 * sigma < wrong < 2.4 * sigma  # 95 % lie within 1.96 sigma
    large = [Camera(camera.viewmat.clone(), camera.K, WIDTH, HEIGHT) for camera in cameras]
    for camera in large:
        camera.viewmat[:3, 3] *= 1e4
    assert disagreement([1e4 * d for d in noisy], large, math.inf, 0.95) == pytest.approx(wrong, rel=1e-9)


def test_views_that_share_nothing_give_none():
    depths, cameras = views(2)
    assert disagreement(depths[:1], cameras[:1], 0.02, 0.95) is None
    turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))  # looks the other way
    opposite = [cameras[0], Camera(turned, cameras[1].K, WIDTH, HEIGHT)]
    assert disagreement(depths, opposite, 0.02, 0.95) is None
    assert disagreement([torch.zeros_like(depth) for depth in depths], cameras, 0.02, 0.95) is None
