"""The compiled voxel lookup against the torch version, as an array and as a hash table."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch

from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.ops import extension

pytestmark = pytest.mark.skipif(extension.load() is None, reason="beags_plugin._native was not built")
SIZE, CLASSES = 0.25, 5


def make_grid(spread: float) -> VisibilityGrid:
    """A dense cloud of classes 1 to 4 and a sparse one of size ``spread``: if large, no array can hold both.

    Every seventh voxel supports the next class too.
    """
    g = torch.Generator().manual_seed(3)
    near, far = torch.rand(3000, 3, generator=g) * 4 - 2, (torch.rand(300, 3, generator=g) - 0.5) * spread
    near_ids = (near[:, 0].floor().int() + 2).clamp(0, 3) + 1
    far_ids = torch.randint(1, CLASSES, (300,), generator=g).int()
    clouds = [(near, near_ids), (far, far_ids)]
    grid = VisibilityGrid.from_points(clouds, SIZE, torch.tensor([0.1, -0.2, 0.3]), CLASSES)
    keys, order = torch.cat([grid.keys, grid.keys[::7]]).sort(stable=True)
    classes = torch.cat([grid.classes, grid.classes[::7] % (CLASSES - 1) + 1])
    return VisibilityGrid(SIZE, grid.origin, CLASSES, keys, classes[order])


def queries(grid: VisibilityGrid, dtype, count: int = 6000):
    """Points around the voxels and between them."""
    g = torch.Generator().manual_seed(4)
    chosen = torch.randint(0, len(grid.keys), (count,), generator=g)
    index = torch.stack(
        [grid.keys[chosen] >> 42, (grid.keys[chosen] >> 21) & 0x1FFFFF, grid.keys[chosen] & 0x1FFFFF], 1
    )
    around = 3 * torch.randn(count, 3, generator=g, dtype=torch.float64)
    points = (index - (1 << 20) + 0.5 + around) * SIZE + grid.origin
    ids = torch.where(torch.rand(count, generator=g) < 0.7, grid.classes[chosen], torch.arange(count) % CLASSES)
    return points.to(dtype), ids.int()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [4.0, 5000.0, 200_000.0])
def test_counts_and_members_are_the_torch_versions(spread, dtype, without_extension, for_threads):
    grid = make_grid(spread)
    points, ids = queries(grid, dtype)
    expected = without_extension(lambda: (grid.count(points, ids), grid.valid(points, ids)))
    assert 0.1 < expected[1].double().mean() < 0.95
    assert torch.equal(expected[0] > 0, expected[1])
    for count, valid in for_threads(lambda: (grid.count(points, ids), grid.valid(points, ids))):
        assert torch.equal(count, expected[0])
        assert torch.equal(valid, expected[1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spread", [4.0, 5000.0])
def test_discs_are_the_torch_versions(spread, dtype, without_extension, for_threads):
    grid = make_grid(spread)
    points, ids = queries(grid, dtype)
    g = torch.Generator().manual_seed(8)
    axes = (
        torch.randn(len(points), 2, 3, generator=g).to(dtype)
        * 0.5
        * torch.rand(len(points), 1, 1, generator=g).to(dtype)
    )
    arguments = (points, axes[:, 0].contiguous(), axes[:, 1].contiguous(), ids)
    expected = without_extension(lambda: grid.disc_inside(*arguments))
    assert 0.01 < expected.double().mean() < 0.9
    for found in for_threads(lambda: grid.disc_inside(*arguments)):
        assert torch.equal(found, expected)


def test_memory_is_linear_in_the_voxels():
    """Two clouds of 300 voxels, one 40,000 times as far apart: an array would take 10^13 times the memory."""
    near, far = make_grid(4.0), make_grid(200_000.0)
    for grid in (near, far):
        assert grid.lookup().native.bytes < 300 * len(grid.keys) + (1 << 20)
    assert far.lookup().native.bytes < 10 * near.lookup().native.bytes + 300 * len(far.keys)


def test_the_first_and_last_voxel_of_the_range():
    size, last = 1.0, float((1 << 20) - 1)
    points = torch.tensor([[-last, 0.0, 0.0], [last, last, -last]], dtype=torch.float64) + 0.25
    ids = torch.tensor([1, 2], dtype=torch.int32)
    grid = VisibilityGrid.from_points([(points, ids)], size, torch.zeros(3), 3)
    assert grid.valid(points, ids).all() and grid.count(points, ids).tolist() == [1, 1]
    beyond = points + torch.tensor([[-2.0, 0.0, 0.0], [2.0, 2.0, -2.0]], dtype=torch.float64)
    assert not grid.valid(beyond, ids).any() and not grid.count(beyond, ids).any()
    assert not grid.valid(points, ids.flip(0)).any()


def test_no_points_and_no_voxels():
    grid, none = make_grid(4.0), VisibilityGrid.from_points([], SIZE, torch.zeros(3), 2)
    nothing = torch.zeros(0, 3)
    assert grid.valid(nothing, torch.zeros(0).int()).shape == (0,)
    assert grid.count(nothing, torch.zeros(0).int()).dtype == torch.int64
    points = torch.zeros(4, 3)
    assert not none.valid(points, torch.tensor([0, 1, 7, -1])).any()
    assert not none.disc_inside(points, points, points, torch.tensor([0, 1, 7, -1])).any()


def test_a_grid_with_a_lookup_can_be_copied():
    grid = make_grid(4.0)
    points, ids = queries(grid, torch.float32, 500)
    expected = grid.valid(points, ids)
    for other in (copy.deepcopy(grid), pickle.loads(pickle.dumps(grid))):
        assert torch.equal(other.valid(points, ids), expected)


def test_wrong_arguments_are_told_by_name():
    lookup = make_grid(4.0).lookup()
    with pytest.raises(ValueError, match="points"):
        lookup.valid(torch.zeros(4, 2), torch.zeros(4))
    with pytest.raises(ValueError, match="class_ids"):
        lookup.count(torch.zeros(4, 3), torch.zeros(3))
    with pytest.raises(ValueError, match="axes_v"):
        lookup.disc_inside(torch.zeros(4, 3), torch.zeros(4, 3), torch.zeros(4, 3).double(), torch.zeros(4))
