"""The class that a voxel supports: the paper's rule and that of votes."""

from __future__ import annotations

import pytest
import torch

from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.support import Sightings

ROWS = [  # views that saw class 0, 1, 2 in a voxel; the class it supports in the paper and by votes
    ((0, 5, 0), 1, 1),
    ((3, 8, 0), None, 1),  # a thin part before a wall: 8 of 11
    ((3, 7, 0), None, None),  # 7 of 10 are not more than 0.7
    ((9, 1, 0), None, 0),
    ((0, 4, 4), None, None),
    ((0, 1, 0), 1, None),  # a wrong depth of one view
    ((0, 2, 0), 1, 1),
    ((1, 0, 0), 0, 0),  # the background at the rim of all views
]


@pytest.mark.parametrize("votes", [False, True])
def test_what_voxels_support(votes):
    """Each view lifts three points into a voxel: it has one vote all the same."""
    clouds = []
    for view in range(9):
        seen = [(x, c) for x, (counts, *_) in enumerate(ROWS) for c, count in enumerate(counts) if view < count]
        points = torch.tensor([[x + 0.5, 0.5, 0.5] for x, _ in seen]).repeat(3, 1)
        clouds.append((points, torch.tensor([c for _, c in seen], dtype=torch.int32).repeat(3)))
    grid = VisibilityGrid.from_points(clouds, 1.0, torch.zeros(3), 3, votes=votes)
    found = {
        round(float(x) - 0.5): c for (x, _, _), c in zip(grid.centres(grid.keys), grid.classes.tolist(), strict=True)
    }
    assert [found.get(x) for x in range(len(ROWS))] == [row[1 + votes] for row in ROWS]


def test_the_order_of_views_does_not_matter():
    g = torch.Generator().manual_seed(0)
    views = [(torch.randint(0, 9, (40,), generator=g), torch.randint(0, 4, (40,), generator=g).int()) for _ in range(7)]
    found = [Sightings(order, 4, torch.device("cpu")) for order in (views, views[::-1])]
    for name in ("keys", "classes", "views"):
        assert torch.equal(getattr(found[0], name), getattr(found[1], name))
    assert int(found[0].views.max()) <= 7 and torch.equal(found[0].by_votes(), found[1].by_votes())
