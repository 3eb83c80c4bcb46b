"""The voxel size (E8)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from beags_plugin.occupancy.voxel_size import MAX_REFERENCE, reference_indices, voxel_size_of_reference

both = pytest.mark.usefixtures("ops")  # run with the torch versions and with the compiled ops

E8 = (4 * math.pi / 3) ** (1 / 3)  # 1.612


def voxel_size(
    points: np.ndarray, k: int = 2000, seed: int = 0, max_reference: int = MAX_REFERENCE, **options
) -> float:
    chosen = reference_indices(len(points), k, seed, max_reference)
    return voxel_size_of_reference(points[chosen], len(points), k, seed, **options)


def _cube_cloud(count: int) -> np.ndarray:
    return np.random.default_rng(0).random((count, 3))


def test_size_of_a_uniform_cloud_is_that_of_k_points():
    """A voxel holds k points of a uniform cloud: s = (k / rho)^(1/3). Boundaries make the mean a little larger."""
    count, k = 60_000, 30
    assert voxel_size(_cube_cloud(count), k=k) == pytest.approx((k / count) ** (1 / 3), rel=0.06)


def test_size_is_1612_times_the_distance_by_brute_force():
    points = np.random.default_rng(1).normal(size=(300, 3))
    distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    for k in (1, 7, 50):
        assert voxel_size(points, k=k) == pytest.approx(E8 * distances[:, k].mean(), rel=1e-12)


def test_thinning_the_cloud_and_sampling_queries_hardly_change_the_size():
    points = _cube_cloud(40_000)
    whole = voxel_size(points, k=400)
    for options in [{"max_reference": kept} for kept in (20_000, 4_000, 3_100)] + [{"num_queries": 20_000}]:
        assert voxel_size(points, k=400, **options) == pytest.approx(whole, rel=0.03)
    assert voxel_size(points[:20_000], k=4, max_reference=100) == voxel_size(points[:20_000], k=4)  # small k: all kept


def test_size_is_deterministic_and_scales():
    points = _cube_cloud(10_000)
    size = voxel_size(points, k=100, seed=3, max_reference=2000)
    assert size == voxel_size(points, k=100, seed=3, max_reference=2000)
    for factor in (1e-4, 1e6):
        assert voxel_size(factor * points, k=100, seed=3, max_reference=2000) == pytest.approx(factor * size, rel=1e-9)


def test_fewer_points_than_k():
    points = np.random.default_rng(2).normal(size=(20, 3))
    with pytest.warns(UserWarning, match="needs 2000 neighbours, but the views show 19"):
        size = voxel_size(points)
    farthest = np.linalg.norm(points[:, None] - points[None], axis=-1).max(1).mean()
    assert size == pytest.approx(E8 * farthest)


def test_coincident_points():
    points = np.repeat(np.random.default_rng(3).normal(size=(10, 3)), 50, axis=0)
    with pytest.warns(UserWarning, match="20 nearest neighbours coincide"):
        assert voxel_size(points, k=20) > 0
    for count in (1, 30):
        with pytest.warns(UserWarning, match="all points of the views coincide"):
            assert voxel_size(np.full((count, 3), 2.0), k=20) == pytest.approx(2e-3)
    with pytest.warns(UserWarning):
        assert voxel_size(np.zeros((4, 3)), k=2) > 0
    with pytest.raises(ValueError, match="empty"):
        voxel_size(np.zeros((0, 3)))
