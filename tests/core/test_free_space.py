"""The space before cameras: where it ends, and what stands in it."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.free_space import LEAST_POINTS, nearest_depths, reaches_before_camera
from beags_plugin.core.surfels import Surfels


def camera(z: float = 0.0, flipped: bool = False) -> Camera:
    """A camera of 40 x 30 pixels at (0, 0, z) that looks along z, or back."""
    viewmat = torch.eye(4)
    if flipped:
        viewmat[0, 0] = viewmat[2, 2] = -1.0
    viewmat[2, 3] = z if flipped else -z
    return Camera(viewmat, torch.tensor([[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]]), 40, 30)


def test_the_nearest_points_say_where_free_space_ends():
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(1000, 3, generator=generator) * torch.tensor([1.0, 1.0, 3.0]) + torch.tensor([-0.5, -0.5, 4.0])
    wrong = points[:10] * 0.1  # a hundredth of them lies far too near
    behind = torch.tensor([[0.0, 0.0, -0.5]]).repeat(100, 1)
    beside = torch.tensor([[3.0, 0.0, 0.5]]).repeat(100, 1)
    (depth,) = nearest_depths(torch.cat([points, wrong, behind, beside]), [camera()]).tolist()
    assert 4.0 <= depth < 4.2
    (scaled,) = nearest_depths(1e4 * torch.cat([points, wrong, behind, beside]), [camera()]).tolist()
    assert scaled == pytest.approx(1e4 * depth, rel=1e-5)


def test_few_points_say_nothing():
    points = torch.tensor([[0.0, 0.0, 2.0]]).repeat(LEAST_POINTS - 1, 1)
    assert nearest_depths(points, [camera()]).tolist() == [0.0]
    assert nearest_depths(torch.cat([points, points[:1]]), [camera()]).tolist() == [2.0]


def discs(means: list[list[float]], scales: tuple[float, float] = (1e-3, 1e-3)) -> Surfels:
    """Discs that face along z, with these scales along x and y."""
    count = len(means)
    return Surfels(
        torch.tensor(means),
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.tensor(scales).log().repeat(count, 1),
        torch.zeros(count),
        torch.zeros(count, 3),
        torch.zeros(count, 0, 3),
    )


def test_what_stands_before_a_camera_is_told_from_what_stands_beside_behind_or_beyond_it():
    means = [
        [0.0, 0.0, 0.5],  # It stands before the camera.
        [0.27, 0.0, 0.5],  # It is beside the picture by less than a tenth of its width.
        [0.4, 0.0, 0.5],  # It is further beside it.
        [0.0, 0.0, -0.5],  # It is behind the camera.
        [0.0, 0.0, 1.1],  # It is beyond the depth.
    ]
    found = reaches_before_camera(discs(means), [camera()], torch.tensor([1.0]))
    assert found.tolist() == [True, True, False, False, False]
    assert not reaches_before_camera(discs(means), [camera()], torch.tensor([0.0])).any(), "nothing is known"
    both = reaches_before_camera(discs(means), [camera(), camera(2.0, flipped=True)], torch.tensor([1.0, 1.0]))
    assert both.tolist() == [True, True, False, False, True], "one view is enough"


def test_a_large_gaussian_beside_the_picture_counts_where_it_reaches_into_it():
    beside = discs([[0.9, 0.0, 0.5]], scales=(0.4, 1e-3))
    assert reaches_before_camera(beside, [camera()], torch.tensor([1.0])).tolist() == [True]
    upright = discs([[0.9, 0.0, 0.5]], scales=(1e-3, 0.4))
    assert reaches_before_camera(upright, [camera()], torch.tensor([1.0])).tolist() == [False]
