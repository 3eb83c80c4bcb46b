"""The visibility grids, and how they are built from views."""

from __future__ import annotations

import itertools
import math
import warnings
from types import SimpleNamespace

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.core.surfels import Surfels
from beags_plugin.occupancy.build import build_visibility_grid
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.occupancy.voxel_size import voxel_size_of_reference
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.system.errors import UserError

both = pytest.mark.usefixtures("ops")  # run with the torch versions and with the compiled ops

E8 = (4 * math.pi / 3) ** (1 / 3)  # 1.612


SIZE, CLASSES = 0.25, 3
ORIGIN = (0.1, 0.0, -0.1)


def _clouds():
    g = torch.Generator().manual_seed(0)
    return [(torch.rand(60, 3, generator=g) * 2 - 0.7, torch.randint(0, CLASSES, (60,), generator=g).int())] * 2


def _grid() -> VisibilityGrid:
    return VisibilityGrid.from_points(_clouds(), SIZE, torch.tensor(ORIGIN, dtype=torch.float64), CLASSES)


def _voxels(points: torch.Tensor, ids: torch.Tensor) -> list[tuple[int, tuple[int, ...]]]:
    found = [tuple(math.floor((x - o) / SIZE) for x, o in zip(point, ORIGIN, strict=True)) for point in points.tolist()]
    return list(zip(ids.tolist(), found, strict=True))


def _by_sets() -> dict[int, set]:
    """V_phi as Python sets of voxels: collisions are empty in all."""
    voxels: dict[int, set] = {c: set() for c in range(CLASSES)}
    for c, voxel in [each for cloud in _clouds() for each in _voxels(*cloud)]:
        voxels[c].add(voxel)
    return {c: voxels[c].difference(*(voxels[o] for o in voxels if o != c)) for c in voxels}


def _queries():
    g = torch.Generator().manual_seed(9)
    return torch.rand(3000, 3, generator=g) * 5 - 2.0, torch.randint(0, CLASSES, (3000,), generator=g).int()


@both
def test_count_and_valid_equal_sets():
    grid, sets = _grid(), _by_sets()
    points, ids = _queries()
    steps = list(itertools.product((-1, 0, 1), repeat=3))
    expected = [sum((x + i, y + j, z + k) in sets[c] for i, j, k in steps) for c, (x, y, z) in _voxels(points, ids)]
    count = grid.count(points, ids)
    assert count.tolist() == expected and max(expected) >= 3
    assert torch.equal(grid.valid(points, ids), count > 0)
    assert 0.05 < (count > 0).float().mean() < 0.95


@both
def test_colliding_classes_leave_a_voxel_empty():
    points = torch.tensor([[0.5, 0.5, 0.5], [0.6, 0.6, 0.6], [5.5, 0.5, 0.5], [5.6, 0.5, 0.5]])
    ids = torch.tensor([1, 2, 1, 1], dtype=torch.int32)
    clouds = [(points[:1], ids[:1]), (points[1:], ids[1:])]  # two views
    grid = VisibilityGrid.from_points(clouds, 1.0, torch.zeros(3), 3)
    assert len(grid.keys) == 1 and grid.classes.tolist() == [1]
    assert grid.count(points, ids).tolist() == [0, 0, 1, 1]
    # class 2 collided everywhere: its grid is empty, and so is D_occ
    far = torch.rand(100, 3, generator=torch.Generator().manual_seed(0)) * 10
    assert not grid.valid(far, torch.full((100,), 2)).any() and not grid.valid(far, torch.zeros(100).int()).any()


@both
def test_empty_grid_and_wild_points():
    none = VisibilityGrid.from_points([], 1.0, torch.zeros(3), 2)
    points = torch.tensor(
        [[0.0, 0, 0], [math.nan, 0, 0], [math.inf, 0, 0], [-math.inf, 0, 0], [1e30, 0, 0], [-3e9, 0, 0]]
    )
    ids = torch.ones(6, dtype=torch.int32)
    assert not none.valid(points, ids).any() and not none.count(points, ids).any()
    one = VisibilityGrid.from_points([(torch.zeros(1, 3), ids[:1])], 1.0, torch.zeros(3), 2)
    assert one.valid(points, ids).tolist() == [True] + [False] * 5
    assert one.count(points, ids).tolist() == [1] + [0] * 5


@both
def test_one_voxel_reaches_exactly_its_27_neighbours():
    grid = VisibilityGrid.from_points([(torch.full((1, 3), 0.5), torch.ones(1).int())], 1.0, torch.zeros(3), 2)
    steps = torch.tensor(list(itertools.product(range(-3, 4), repeat=3)))
    valid = grid.valid(steps + 0.5, torch.ones(len(steps)).int())
    assert torch.equal(valid, (steps.abs() <= 1).all(1))


@both
@pytest.mark.parametrize("factor", [1e-4, 1e6])
def test_grids_scale(factor):
    points, ids = _queries()
    scaled = VisibilityGrid.from_points(
        [((p.double() * factor), c) for p, c in _clouds()],
        SIZE * factor,
        torch.tensor(ORIGIN, dtype=torch.float64) * factor,
        CLASSES,
    )
    agree = scaled.count(points.double() * factor, ids) == _grid().count(points, ids)
    assert agree.float().mean() > 0.998  # a point on a voxel's face may round to either side


@both
def test_state_dict_round_trip(tmp_path):
    grid = _grid()
    torch.save(grid.state_dict(), tmp_path / "grid.pt")
    back = VisibilityGrid.from_state_dict(torch.load(tmp_path / "grid.pt", weights_only=True))
    points, ids = _queries()
    assert back.voxel_size == grid.voxel_size and torch.equal(back.count(points, ids), grid.count(points, ids))
    assert torch.equal(back.valid(points, ids), grid.valid(points, ids))


def test_too_many_voxels_are_told():
    points = torch.tensor([[0.0, 0, 0], [3e6, 0, 0]])
    with pytest.raises(UserError, match="raise k"):
        VisibilityGrid.from_points([(points, torch.ones(2).int())], 1.0, torch.zeros(3), 2)


@both
@pytest.mark.parametrize("origin", [ORIGIN, (1000.1, -500.0, 0.0)])
def test_disc_inside_is_never_wrong(origin):
    """Every one of many points of every disc that is called inside is valid; float32 far from 0 as well."""
    g = torch.Generator().manual_seed(4)
    shift = torch.tensor(origin) - torch.tensor(ORIGIN)
    clouds = [(torch.rand(3000, 3, generator=g) * 1.5 + shift, torch.ones(3000).int())]
    grid = VisibilityGrid.from_points(clouds, SIZE, torch.tensor(origin, dtype=torch.float64), 2)
    count = 4000
    means = torch.rand(count, 3, generator=g) * 2.6 - 0.5 + shift
    axes = torch.randn(count, 2, 3, generator=g) * (0.3 * torch.rand(count, 1, 1, generator=g))
    ids = torch.ones(count).int()
    inside = grid.disc_inside(means, axes[:, 0], axes[:, 1], ids)
    assert 0.05 < inside.float().mean() < 0.9
    angle = torch.linspace(0, 2 * math.pi, 181)
    every = torch.ones(count, dtype=torch.bool)
    for a in angle:
        for radius in (1.0, 0.5, 0.0):
            every &= grid.valid(means + radius * (a.cos() * axes[:, 0] + a.sin() * axes[:, 1]), ids)
    assert not (inside & ~every).any()
    assert not grid.disc_inside(means, axes[:, 0], axes[:, 1], 0 * ids).any()


@both
def test_large_and_broken_discs_are_not_inside():
    clouds = [(torch.rand(20000, 3, generator=torch.Generator().manual_seed(5)) * 10, torch.ones(20000).int())]
    grid = VisibilityGrid.from_points(clouds, 1.0, torch.zeros(3), 2)
    means = torch.tensor([[5.0, 5, 5], [5.0, 5, 5], [math.nan, 5, 5], [5.0, 5, 5]])
    u = torch.tensor([[0.1, 0, 0], [2.0, 0, 0], [0.1, 0, 0], [math.inf, 0, 0]])
    v = torch.tensor([[0.0, 0.1, 0]]).expand(4, 3)
    assert grid.disc_inside(means, u, v, torch.ones(4).int()).tolist() == [True, False, False, False]


class _Stub:
    """Renders the images of its views."""

    def rasterize(self, inputs, camera, settings, background, target=None):
        assert settings.geometry and not inputs.means.requires_grad
        return SimpleNamespace(alpha=camera.alpha, depth=camera.depth, median_depth=camera.median_depth)

    def class_map(self, inputs, camera, settings, num_classes):
        return camera.classes, camera.alpha


class _View(Camera):
    pass


def _view(seed: int, width: int = 24, height: int = 18) -> _View:
    g = torch.Generator().manual_seed(seed)
    viewmat = torch.eye(4)
    viewmat[:3, 3] = torch.randn(3, generator=g) * 0.1
    view = _View(viewmat, torch.tensor([[20.0, 0, 12.2], [0, 20.0, 8.7], [0, 0, 1]]), width, height)
    for name, value in {
        "alpha": torch.rand(height, width, generator=g),
        "depth": 2 + torch.rand(height, width, generator=g),
        "median_depth": 4 + torch.rand(height, width, generator=g),
        "classes": torch.randint(0, CLASSES, (height, width), generator=g).int(),
    }.items():
        object.__setattr__(view, name, value)
    return view


def _surfels(count: int = 1) -> Surfels:
    return Surfels.of(*(torch.zeros(shape) for shape in [(count, 3), (count, 4), (count, 2), (count,), (count, 1, 3)]))


SETTINGS = RasterSettings(near=0.1, far=100.0, geometry=False)


def _build(views, depth: str = "median", **options) -> VisibilityGrid:
    ids = torch.arange(CLASSES).int()
    return build_visibility_grid(_surfels(CLASSES), ids, views, _Stub(), SETTINGS, CLASSES, depth=depth, **options)


@pytest.mark.parametrize("kind", ["median", "expected"])
def test_build_lifts_solid_pixels_of_all_views(kind):
    views, calls = [_view(0), _view(1, 30, 20), _view(2)], []
    grid = _build(views, kind, k=3, progress=lambda *state: calls.append(state))
    solid = [view.alpha >= 0.5 for view in views]
    depths = [view.median_depth if kind == "median" else view.depth for view in views]
    points = torch.cat([lift(d, v)[s] for d, v, s in zip(depths, views, solid, strict=True)])
    ids = torch.cat([v.classes[s] for v, s in zip(views, solid, strict=True)])
    together = voxel_size_of_reference(points.numpy(), len(points), k=3)  # the size for all classes together
    assert grid.voxel_size == pytest.approx(together)
    expected = VisibilityGrid.from_points([(points, ids)], grid.voxel_size, grid.origin, CLASSES)
    assert len(expected.keys) > 10
    assert torch.equal(grid.keys, expected.keys) and torch.equal(grid.classes, expected.classes)
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_build_skips_depths_that_cannot_be_lifted():
    view = _view(3)
    view.median_depth[2, :] = math.nan
    view.median_depth[3, :] = 0.0
    assert math.isfinite(_build([view], k=5).voxel_size)
    view.alpha.fill_(0.3)
    with pytest.raises(UserError, match="anything solid"):
        _build([view])


def test_build_with_the_reference_rasterizer():
    """Two patches of surfels side by side: each patch is valid for its own class only."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, 8), torch.linspace(-0.6, 0.6, 6), indexing="xy")
    means = torch.stack([x, y, torch.full_like(x, 4.0)], -1).view(-1, 3)
    count = len(means)
    quats, scales = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 2), math.log(0.15))
    surfels = Surfels.of(means, quats, scales, torch.full((count,), 4.0), torch.zeros(count, 1, 3))
    ids = (means[:, 0] > 0).int() + 1
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 16], [0, 40.0, 12], [0, 0, 1]]), 32, 24)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        grid = build_visibility_grid(surfels, ids, [camera], make_rasterizer("torch"), SETTINGS, 3, k=10)
    assert grid.valid(means, ids).float().mean() > 0.95
    outer = means[:, 0].abs() > 3 * grid.voxel_size
    assert outer.any() and not grid.valid(means[outer], 3 - ids[outer]).any()
    assert not grid.valid(means - torch.tensor([0.0, 0.0, 3.0]), ids).any()


def test_a_grid_of_some_classes_answers_the_same_about_them(ops):
    g = torch.Generator().manual_seed(9)
    points, ids = torch.rand(3000, 3, generator=g) * 2, torch.randint(0, 4, (3000,), generator=g)
    grid = VisibilityGrid.from_points([(points, ids)], 0.2, torch.zeros(3), 4)
    part = grid.only(torch.tensor([3, 1]))
    asked = torch.rand(4000, 3, generator=g) * 2.4 - 0.2
    classes = torch.arange(4000) % 4
    kept = (classes == 1) | (classes == 3)
    assert torch.equal(part.count(asked, classes)[kept], grid.count(asked, classes)[kept])
    assert torch.equal(part.valid(asked, classes)[kept], grid.valid(asked, classes)[kept])
    assert grid.valid(asked, classes)[~kept].any() and not part.valid(asked, classes)[~kept].any()
    assert len(part.keys) < len(grid.keys)
    assert not grid.only(torch.tensor([], dtype=torch.int64)).valid(asked, classes).any()
