"""Space that no view has seen supports what it lies in; space that rays have passed through supports nothing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.unseen import with_unseen

SIZE = 0.1
SIDE = 32


@dataclass(frozen=True)
class Shown:
    """A view at the origin along +z, of a surface at some depth."""

    depth: Tensor
    camera: Camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 16], [0, 40.0, 16], [0, 0, 1]]), SIDE, SIDE)

    def surface(self) -> Tensor:
        return self.depth


def wall(depth: float = 4.0) -> Shown:
    return Shown(torch.full((SIDE, SIDE), depth))


def discs(*means: tuple[float, float, float], scales: tuple[float, float] = (0.05, 0.05)) -> Surfels:
    count = len(means)
    return Surfels.of(
        torch.tensor(means, dtype=torch.float32), torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        torch.tensor([scales]).log().repeat(count, 1), torch.zeros(count), torch.zeros(count, 1, 3),
    )  # fmt: skip


def cube(low: float, high: float, at: float = 0.0) -> Tensor:
    """Return points all over a cube's six sides, centred at (0, 0, at)."""
    line = torch.arange(low, high + 1e-6, SIZE / 2)
    points = torch.cartesian_prod(line, line, line)
    ends = (points - low).abs().amin(1).minimum((points - high).abs().amin(1)) < 1e-6
    return points[ends] + torch.tensor([0.0, 0.0, at])


def grid_of(*clouds: Tensor) -> VisibilityGrid:
    pairs = [(cloud, torch.full((len(cloud),), class_id)) for class_id, cloud in enumerate(clouds)]
    return VisibilityGrid.from_points(pairs, SIZE, torch.zeros(3, dtype=torch.float64), max(len(clouds), 2))


def valid(grid: VisibilityGrid, surfels: Surfels) -> list[list[bool]]:
    """Return whether each disc's centre is valid for each class."""
    of_classes = [
        grid.valid(surfels.means, torch.full((len(surfels),), class_id)) for class_id in range(grid.num_classes)
    ]
    return torch.stack(of_classes, dim=1).tolist()


def test_space_behind_surfaces_and_beside_pictures_supports_the_background():
    view = wall()
    grid = grid_of(lift(view.surface(), view.camera).view(-1, 3))
    asked = discs((0, 0, 2), (0, 0, 6), (9, 0, 4), (0, 0, -3))
    assert valid(grid, asked) == [[False, False]] * 4
    ids = torch.ones(4, dtype=torch.int32)
    found = with_unseen(grid, asked, ids, [view])
    assert valid(found, asked) == [[False, False], [True, False], [True, False], [True, False]]
    behind = Shown(torch.full((SIDE, SIDE), 7.0))  # a view that has seen what lies behind the wall
    assert valid(with_unseen(grid, asked, ids, [view, behind]), asked)[1] == [False, False]
    assert found.voxel_size == grid.voxel_size and torch.equal(found.keys, found.keys.unique())


def test_a_surface_is_not_passed_and_what_lies_before_it_by_less_than_depths_are_sure_of():
    view = wall()
    asked = discs((0.05, 0.05, 4.02), (0.05, 0.05, 3.85), (0.05, 0.05, 3.0))
    found = with_unseen(grid_of(torch.zeros(0, 3)), asked, torch.ones(3, dtype=torch.int32), [view])
    assert torch.isin(found.keys_of(asked.means), found.keys).tolist() == [False, True, False]  # the first was seen
    nothing = Shown(torch.zeros(SIDE, SIDE))  # nothing solid: rays pass
    found = with_unseen(grid_of(torch.zeros(0, 3)), asked, torch.ones(3, dtype=torch.int32), [nothing])
    assert not any(row[0] for row in valid(found, asked))


def test_unseen_space_inside_an_object_is_the_objects_that_of_the_smallest_around_it():
    large, small = cube(-1.0, 1.0), cube(-0.3, 0.3)
    strays = torch.tensor([[5.0, 5.0, 5.0], [-5.0, 5.0, -5.0], [5.0, -5.0, 5.0], [-5.0, -5.0, 5.0]])
    grid = grid_of(torch.zeros(0, 3), large, torch.cat([small, strays]))
    asked = discs((0, 0, 0), (0.65, 0, 0), (3.0, 0, 0), (0.02, 0.03, -2.5))
    found = with_unseen(grid, asked, torch.zeros(4, dtype=torch.int32), [])
    outside = [True, False, False]
    assert valid(found, asked) == [[False, False, True], [False, True, False], outside, outside]
    both = discs((0, 0, 0.27))  # at the border of the small cube
    assert valid(with_unseen(grid, both, torch.zeros(1, dtype=torch.int32), []), both) == [[False, True, True]]
    assert torch.equal(found.classes[torch.isin(found.keys, grid.keys)], grid.classes)  # what was seen stays


@pytest.mark.parametrize("hollow", [True, False])
def test_what_stands_in_a_hollow_object_goes_on_where_nobody_could_look(hollow: bool):
    view = wall(6.0)
    view.depth[10:22, 10:22] = 4.5 if hollow else 3.4  # the bottom of a cup that opens to the camera, or a lid
    view.depth[15:17, 15:17] = 3.9  # a stick that stands in it
    stick, cup, far = cube(-0.15, 0.15, 4.0), cube(-0.6, 0.6, 4.0), cube(-0.2, 0.2) + torch.tensor([3.0, 0, 4.0])
    grid = grid_of(torch.zeros(0, 3), stick, cup, far)
    asked = discs((0.0, 0.0, 4.35), (0.0, 0.0, 5.2))
    found = with_unseen(grid, asked, torch.ones(2, dtype=torch.int32), [view])
    assert valid(found, asked) == [[False, hollow, True, False], [True, False, False, False]]


@pytest.mark.parametrize("scales", [(1.0, 1.0), (1.5, 0.01)])
def test_large_and_long_discs_are_covered(scales):
    surfels = discs((0, 0, 0), (20.0, 0, 0), scales=scales)
    found = with_unseen(grid_of(torch.zeros(0, 3)), surfels, torch.zeros(2, dtype=torch.int32), [])
    g = torch.Generator().manual_seed(0)
    radius, angle = 3 * torch.rand(20_000, generator=g).sqrt(), 2 * math.pi * torch.rand(20_000, generator=g)
    uv = radius[:, None] * torch.stack([angle.cos(), angle.sin()], -1) * torch.tensor(scales)
    points = torch.cat([uv, torch.zeros(20_000, 1)], 1)
    assert found.valid(points, torch.zeros(20_000, dtype=torch.int32)).all()


def test_the_order_of_gaussians_and_broken_ones_change_nothing():
    g = torch.Generator().manual_seed(1)
    means = [tuple(row) for row in (4 * torch.rand(300, 3, generator=g)).tolist()]
    surfels, ids = discs(*means), torch.randint(0, 2, (300,), generator=g).int()
    view = wall(2.0)
    grid = grid_of(lift(view.surface(), view.camera).view(-1, 3), cube(0.2, 0.9, 2.0))
    expected = with_unseen(grid, surfels, ids, [view])
    assert len(expected.keys) > len(grid.keys) + 300
    order = torch.randperm(300, generator=g)
    broken = discs((math.nan, 0, 0), (0, math.inf, 0), (0, 0, 1e30))
    flat = discs((0, 0, 3.0), scales=(math.inf, 0.0))
    parts = [surfels[order], broken, flat]
    mixed = Surfels.of(*(torch.cat(columns) for columns in zip(*(_fields(part) for part in parts), strict=True)))
    found = with_unseen(grid, mixed, torch.cat([ids[order], torch.zeros(4, dtype=torch.int32)]), [view])
    assert torch.equal(found.keys, expected.keys) and torch.equal(found.classes, expected.classes)


def _fields(part: Surfels) -> tuple[Tensor, ...]:
    return part.means, part.quats, part.log_scales, part.opacity_logits, part.sh
