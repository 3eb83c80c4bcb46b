"""The graph of a surface: what it says of lengths and areas where Gaussians lie more densely."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from beags_plugin.core.surfels import Surfels
from beags_plugin.picking.graph import LONGEST, SHORTEST, mean_lengths, surface_graph

HALF = 4.0  # half of the square's side


@pytest.fixture(scope="module")
def plane():
    """A square in the xy plane whose Gaussians lie twice as densely at x > 0, and their graph."""
    generator = np.random.default_rng(0)
    points = []
    for side, step in ((-1.0, 0.2), (1.0, 0.1)):
        across, along = np.arange(0.5 * step, HALF, step), np.arange(-HALF + 0.5 * step, HALF, step)
        x, y = np.meshgrid(side * across, along, indexing="ij")
        square = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        square[:, :2] += generator.uniform(-0.3 * step, 0.3 * step, (x.size, 2))
        points.append(square)
    means = torch.from_numpy(np.concatenate(points)).float()
    count = len(means)
    surfels = Surfels(
        means, torch.zeros(count, 4), torch.zeros(count, 2), torch.zeros(count), torch.zeros(count, 3),
        torch.zeros(count, 0, 3),
    )  # fmt: skip
    up = np.tile([0.0, 0.0, 1.0], (count, 1))
    return surface_graph(surfels, np.ones(count), up)


def crossing(graph, line: float) -> np.ndarray:
    """Return which links cross x = line."""
    x = graph.centres[:, 0] - line
    return x[graph.first] * x[graph.second] < 0


def test_a_border_is_as_long_where_gaussians_lie_twice_as_densely(plane):
    sparse, dense = crossing(plane, -0.5 * HALF), crossing(plane, 0.5 * HALF)
    assert dense.sum() > 1.8 * sparse.sum(), "the number of links alone would do"
    assert plane.lengths[dense].sum() == pytest.approx(plane.lengths[sparse].sum(), rel=0.1)


def test_a_piece_has_the_same_area_where_gaussians_lie_twice_as_densely(plane):
    left = plane.centres[:, 0] < 0
    assert (~left).sum() == 4 * left.sum()
    assert plane.areas[~left].sum() == pytest.approx(plane.areas[left].sum(), rel=0.1)


def test_twins_and_strays_keep_a_length_within_bounds():
    first, second = np.array([0, 1]), np.array([1, 2])
    found = mean_lengths(np.array([0.0, 50.0]), first, second, 4)
    assert found.tolist() == [SHORTEST, LONGEST, LONGEST, SHORTEST]
