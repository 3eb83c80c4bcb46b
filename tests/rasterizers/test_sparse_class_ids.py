"""Class ids that lie far apart cost what neighbouring ids cost, and give the same bits."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.occupancy import OccupancyLoss
from beags_plugin.masks import reprojection
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.options.stages import PreparationConfig
from beags_plugin.preparation.pipeline import Preparation, prepare
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import render_class_map
from beags_plugin.refiners.bea import BeaRefiner
from beags_plugin.system.errors import UserError

NEAR, FAR = (0, 1, 2), (0, 7, 65534)  # the same three classes
SETTINGS = RasterSettings(near=0.1, far=100.0)
WIDTH, HEIGHT = 32, 20


def renamed(values: torch.Tensor, ids: tuple[int, ...]) -> torch.Tensor:
    """Ids of ``NEAR`` as those of ``ids``; IGNORE stays."""
    table = torch.full((IGNORE + 1,), IGNORE, dtype=torch.int32)
    table[: len(ids)] = torch.tensor(ids, dtype=torch.int32)
    return table[values.long()]


def make_surfels() -> Surfels:
    """A wall of 300 surfels across the view."""
    g = torch.Generator().manual_seed(1)
    means = torch.rand(300, 3, generator=g) * torch.tensor([3.0, 2.0, 0.2]) + torch.tensor([-1.5, -1.0, 3.0])
    quats = torch.randn(300, 4, generator=g) * 0.1 + torch.tensor([1.0, 0, 0, 0])
    return Surfels.of(means, quats, torch.full((300, 2), -2.3), torch.full((300,), 3.0), torch.zeros(300, 1, 3))


def make_views() -> tuple[list[Camera], list[torch.Tensor | None]]:
    """Four cameras side by side; three masks with a class per third of the width, mistakes, and unlabelled pixels."""
    g = torch.Generator().manual_seed(2)
    cameras, masks = [], []
    for index in range(4):
        viewmat = torch.eye(4)
        viewmat[0, 3] = 0.1 * index
        cameras.append(Camera(viewmat, torch.tensor([[24.0, 0, 16], [0, 24.0, 10], [0, 0, 1]]), WIDTH, HEIGHT))
        mask = (3 * torch.arange(WIDTH) // WIDTH).int().expand(HEIGHT, WIDTH).clone()
        chance = torch.rand(HEIGHT, WIDTH, generator=g)
        mask[chance < 0.1] = 2
        mask[chance > 0.9] = IGNORE
        masks.append(mask)
    return cameras, [*masks[:3], None]


@dataclass
class Recorder:
    """A rasterizer that notes how many classes it is asked for."""

    inner: object
    asked: list[int]

    def rasterize(self, *arguments):
        return self.inner.rasterize(*arguments)

    def sparse_class_contributions(self, *arguments):
        self.asked.append(arguments[-1])
        return self.inner.sparse_class_contributions(*arguments)

    def class_map(self, *arguments):
        self.asked.append(arguments[-1])
        return self.inner.class_map(*arguments)


def prepared(rasterizer, ids: tuple[int, ...], names=None, **options) -> tuple[Preparation, list[int]]:
    cameras, masks = make_views()
    masks = [None if mask is None else renamed(mask, ids) for mask in masks]
    recorder = Recorder(rasterizer, [])
    names = names or {index: f"name {place}" for place, index in enumerate(ids)}
    config = PreparationConfig(k=20, **options)
    return prepare(make_surfels(), cameras, masks, names, recorder, SETTINGS, BeaRefiner(), config), recorder.asked


@pytest.mark.parametrize("method", ["pairwise", "voxel", "none"])
def test_preparation_gives_the_same_bits(method, rasterizer, monkeypatch):
    asked = []
    pairwise = reprojection.reproject_pairwise

    def recorded(depths, cameras, labels, num_classes, **options):
        asked.append(num_classes)
        return pairwise(depths, cameras, labels, num_classes, **options)

    monkeypatch.setattr(reprojection, "reproject_pairwise", recorded)
    near, _ = prepared(rasterizer, NEAR, reprojection=method)
    far, classes_asked = prepared(rasterizer, FAR, reprojection=method)
    assert asked == ([3, 3] if method == "pairwise" else [])
    assert classes_asked == [3] * 8  # class maps and masks
    assert near.summary == far.summary
    for old, new in zip(near.labels, far.labels, strict=True):
        assert torch.equal(renamed(old, FAR), new) and new.dtype == torch.int32
    assert set(near.assignment.class_ids.tolist()) == set(NEAR)
    assert torch.equal(renamed(near.assignment.class_ids, FAR), far.assignment.class_ids)
    assert torch.equal(near.assignment.margin, far.assignment.margin)
    assert torch.equal(near.assignment.never_seen, far.assignment.never_seen)
    assert len(set(near.grid.classes.tolist())) == 3
    assert torch.equal(near.grid.keys, far.grid.keys) and near.grid.voxel_size == far.grid.voxel_size
    assert torch.equal(renamed(near.grid.classes, FAR), far.grid.classes)


def test_an_unnamed_id_below_the_last_keeps_its_votes(rasterizer):
    names = {0: "background", 65534: "cup"}
    unnamed, asked = prepared(rasterizer, FAR, names)
    assert torch.equal(unnamed.assignment.class_ids, prepared(rasterizer, FAR)[0].assignment.class_ids)
    assert 7 in unnamed.assignment.class_ids.tolist() and max(asked) == 3


def test_an_id_above_the_last_named_one_is_refused(rasterizer):
    with pytest.raises(UserError, match=r"view 0 holds class ids 0\.\.65534, but only 0\.\.900 are known"):
        prepared(rasterizer, FAR, {0: "background", 7: "cup", 900: "box"}, reprojection="none")


def make_grids() -> list[VisibilityGrid]:
    g = torch.Generator().manual_seed(3)
    points = torch.rand(4000, 3, generator=g) * 4
    classes = (points[:, 0] * 0.7).floor().clamp(0, 2).int()
    return [
        VisibilityGrid.from_points([(points, renamed(classes, ids))], 0.3, torch.zeros(3), ids[-1] + 1)
        for ids in (NEAR, FAR)
    ]


def test_grids_answer_the_same_in_the_same_memory(ops):
    near, far = make_grids()
    g = torch.Generator().manual_seed(4)
    points = torch.rand(5000, 3, generator=g) * 6 - 1
    ids = torch.randint(0, 3, (5000,), generator=g).int()
    axes = 0.2 * torch.randn(2, 5000, 3, generator=g)
    assert 0.1 < near.valid(points, ids).float().mean() < 0.9
    assert 0.01 < near.disc_inside(points, *axes, ids).float().mean() < 0.9
    assert torch.equal(near.valid(points, ids), far.valid(points, renamed(ids, FAR)))
    assert torch.equal(near.count(points, ids), far.count(points, renamed(ids, FAR)))
    assert torch.equal(near.disc_inside(points, *axes, ids), far.disc_inside(points, *axes, renamed(ids, FAR)))
    for unknown in (-1, 1, 6, 8, 65533, 70000):  # none of FAR
        assert not far.valid(points, torch.full_like(ids, unknown)).any()
        assert not far.count(points, torch.full_like(ids, unknown)).any()
    if ops == "compiled":
        assert near.lookup().native.bytes == far.lookup().native.bytes
    else:
        assert len(near._valid_keys) == len(far._valid_keys)


@pytest.mark.parametrize("background", [True, False])
def test_the_occupancy_loss_is_the_same(background, ops):
    results = []
    g = torch.Generator().manual_seed(5)
    means, quats = torch.rand(400, 3, generator=g) * 4, torch.randn(400, 4, generator=g)
    scales, classes = torch.rand(400, 2, generator=g) * 2 - 4, torch.randint(0, 3, (400,), generator=g).int()
    for grid, ids in zip(make_grids(), (NEAR, FAR), strict=True):
        leaves = [value.clone().requires_grad_() for value in (means, quats, scales, torch.zeros(400))]
        inputs = LossInputs(
            step=5, seed=6, surfels=Surfels.of(*leaves, sh=torch.zeros(400, 1, 3)), camera=None, render=None,
            image=None, class_ids=renamed(classes, ids), grid=grid,
        )  # fmt: skip
        value = OccupancyLoss(background=background).value(inputs)
        results.append([value.detach(), *torch.autograd.grad(value, leaves)])
    assert float(results[0][0]) > 0
    for near, far in zip(*results, strict=True):
        assert torch.equal(near, far)


def test_a_grid_saved_by_a_former_run_loads(ops):
    """Exactly these five tensors were on disk before, with the ids themselves as classes."""
    near, far = make_grids()
    state = {
        "voxel_size": torch.tensor(0.3, dtype=torch.float64),
        "origin": torch.zeros(3, dtype=torch.float64),
        "num_classes": torch.tensor(65535),
        "keys": near.keys,
        "classes": renamed(near.classes, FAR),
    }
    assert {name: value.dtype for name, value in far.state_dict().items()} == {
        name: value.dtype for name, value in state.items()
    }
    points, ids = torch.rand(1000, 3, generator=torch.Generator().manual_seed(6)) * 4, torch.arange(1000).int() % 3
    loaded = VisibilityGrid.from_state_dict(state)
    assert torch.equal(loaded.valid(points, renamed(ids, FAR)), near.valid(points, ids))


def test_class_maps_of_sparse_ids(rasterizer):
    classes = torch.arange(300).int() % 3
    camera = make_views()[0][0]
    recorder = Recorder(rasterizer, [])
    near = render_class_map(rasterizer, make_surfels(), classes, camera, SETTINGS)
    far = render_class_map(recorder, make_surfels(), renamed(classes, FAR), camera, SETTINGS)
    assert recorder.asked == [3]
    assert set(near[0].unique().tolist()) == set(NEAR)
    assert torch.equal(renamed(near[0], FAR), far[0]) and torch.equal(near[1], far[1])


def test_ranks_are_in_the_order_of_the_ids():
    known = ClassRanks(torch.tensor([[9, 65534], [9, 4]]))
    assert known.ids.tolist() == [0, 4, 9, 65534] and len(known) == 4 and not known.trivial
    found = known.ranks(torch.tensor([[4, 0, 65534], [9, 5, -1]]))
    assert found.dtype == torch.int32 and found.tolist() == [[1, 0, 3], [2, 4, 4]]
    assert known.class_ids(found[0]).tolist() == [4, 0, 65534]
    assert ClassRanks(torch.tensor([], dtype=torch.int32)).ids.tolist() == [0]
    assert ClassRanks(torch.tensor([2, 1])).trivial
