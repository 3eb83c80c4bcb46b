"""Lifting and projecting against the camera model written out for one pixel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import TAU, hides, lift, pixel_rays, project


def _camera(skew: float = 0.0) -> Camera:
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64))[0]
    rotation *= torch.linalg.det(rotation).sign()
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, torch.tensor([0.3, -0.2, 1.5])
    K = torch.tensor([[30.0, skew, 3.1], [0.0, 41.0, 2.2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Camera(viewmat, K, 7, 5)


@pytest.mark.parametrize("skew", [0.0, 2.5])
def test_lift_solves_the_camera_equation_of_every_pixel(skew):
    camera = _camera(skew)
    depth = 1.0 + torch.rand(5, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    points = lift(depth, camera).numpy()
    K, W, t = camera.K.numpy(), camera.rotation.numpy(), camera.translation.numpy()
    for j in range(5):
        for i in range(7):
            homogeneous = K @ (W @ points[j, i] + t)
            assert np.allclose(homogeneous, depth[j, i].item() * np.array([i + 0.5, j + 0.5, 1.0]), atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_surface_hides_what_lies_behind_it_by_more_than_a_fiftieth(dtype):
    """The same bits for tensors and arrays, at the threshold too; no surface and no hit hide nothing."""
    depth = np.linspace(0.1, 100.0, 999, dtype=dtype)
    limit = ((1.0 - TAU) * depth).astype(dtype)
    for surface, hidden in (
        (limit, False), (np.nextafter(limit, dtype(0)), True), (0 * depth, False), (1.01 * depth, False),
        (depth, False), (np.full_like(depth, np.inf), False), (np.full_like(depth, np.nan), False),
    ):  # fmt: skip
        found = hides(surface, depth)
        assert found.dtype == bool and (found == hidden).all()
        assert np.array_equal(hides(torch.from_numpy(surface), torch.from_numpy(depth)).numpy(), found)
    assert hides(depth, np.full_like(depth, np.inf)).all()  # rays that miss a mesh


def test_project_undoes_lift():
    camera = _camera(1.0)
    depth = 1.0 + torch.rand(5, 7, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    xy, z = project(lift(depth, camera).view(-1, 3), camera)
    x, y = torch.meshgrid(torch.arange(7.0) + 0.5, torch.arange(5.0) + 0.5, indexing="xy")
    assert torch.allclose(xy, torch.stack([x, y], -1).view(-1, 2).double())
    assert torch.allclose(z, depth.view(-1))


def test_no_depth_gives_the_camera_position_and_the_dtype_is_kept():
    camera = _camera()
    points = lift(torch.zeros(5, 7), camera)
    assert points.dtype == torch.float32
    assert torch.allclose(points, camera.center.float().expand(5, 7, 3), atol=1e-6)


def test_rays_have_unit_depth_and_the_principal_point_looks_ahead():
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 2.5], [0, 10.0, 1.5], [0, 0, 1]]), 5, 3)
    rays = pixel_rays(camera, torch.zeros(()))
    assert torch.equal(rays[1, 2], torch.tensor([0.0, 0.0, 1.0]))
    assert (rays[..., 2] == 1).all()


def test_points_do_not_depend_on_threads():
    camera, depth = _camera(), torch.rand(5, 7, generator=torch.Generator().manual_seed(4))
    camera = Camera(camera.viewmat, camera.K, 700, 500)
    depth = depth.repeat(100, 100)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(lift(depth, camera))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*results)


def test_wrong_size_is_named():
    with pytest.raises(ValueError, match=r"\[5, 7\]"):
        lift(torch.zeros(7, 5), _camera())
