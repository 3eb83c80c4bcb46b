"""The silhouette loss: what an object rendered alone covers beside its mask, with what may be hidden left out."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import lift
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE, objects_in
from beags_plugin.losses import silhouette
from beags_plugin.losses.base import LossInputs
from beags_plugin.losses.class_members import ClassMembers
from beags_plugin.losses.silhouette import SilhouetteLoss
from beags_plugin.occupancy.grid import VisibilityGrid
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.system.errors import UserError

SETTINGS = RasterSettings(near=0.1, far=100.0)
SIZE = 24
CAMERA = Camera(torch.eye(4), torch.tensor([[20.0, 0.0, 12.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]]), SIZE, SIZE)
RASTERIZER = make_rasterizer("torch")


def draw(inputs, camera):
    return RASTERIZER.rasterize(inputs, camera, SETTINGS, torch.zeros(3))


def scene(depths) -> Surfels:
    """Discs that face the camera, side by side, opaque."""
    count = len(depths)
    means = torch.tensor([[0.5 * index - 0.6, 0.1, depth] for index, depth in enumerate(depths)])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1)
    log_scales = torch.full((count, 2), -1.3)
    return Surfels.of(means, quats, log_scales, torch.full((count,), 2.0), torch.zeros(count, 1, 3))


def inputs_of(surfels, class_ids, labels, step: int = 0) -> LossInputs:
    render = draw(surfel_inputs(surfels, CAMERA), CAMERA)
    return LossInputs(
        step, 0, surfels, CAMERA, render, torch.zeros(SIZE, SIZE, 3), labels, torch.tensor(class_ids).int(), draw=draw
    )


def columns(*ids_and_widths) -> torch.Tensor:
    """[SIZE, SIZE] int32 stripes."""
    ids, widths = zip(*ids_and_widths, strict=True)
    return torch.tensor(ids).repeat_interleave(torch.tensor(widths)).int().repeat(SIZE, 1)


def counted(alpha, labels, class_id) -> torch.Tensor:
    """What is wrong at each pixel; pixels of two classes may be covered in part."""
    wrong = torch.where(labels == class_id, torch.zeros_like(alpha), alpha)
    return torch.where(at_border(labels), (wrong - 0.4).clamp_min(0.0), wrong)


def test_equals_the_alpha_of_each_object_against_its_mask():
    surfels, class_ids = scene([3.0, 3.0, 3.0]), [1, 2, 0]
    labels = columns((1, 8), (2, 6), (IGNORE, 2), (0, 8))
    found = SilhouetteLoss(objects=2).value(inputs_of(surfels, class_ids, labels))
    expected = 0.0
    for rank, class_id in enumerate([1, 2]):  # equally deep: nothing is hidden
        alpha = draw(surfel_inputs(surfels[torch.tensor([rank])], CAMERA), CAMERA).alpha
        wrong = counted(alpha, labels, class_id)
        expected += float(wrong[labels != IGNORE].sum())
    assert float(found) == pytest.approx(expected / (SIZE * (SIZE - 2)), rel=1e-5)


def test_what_the_host_knows_changes_no_bit():
    surfels, class_ids = scene([3.0, 3.0, 3.2]), [1, 2, 1]
    asked = inputs_of(surfels, class_ids, columns((1, 8), (2, 6), (IGNORE, 2), (0, 8)))
    known_on_host = replace(asked, members=ClassMembers(asked.class_ids), present=objects_in(asked.labels))
    for loss in (SilhouetteLoss(), SilhouetteLoss(objects=2)):
        assert torch.equal(loss.value(known_on_host), loss.value(asked)) and float(loss.value(known_on_host)) > 0.0
    assert float(SilhouetteLoss().value(replace(known_on_host, present=[]))) == 0.0


def test_what_lies_behind_another_surface_may_be_covered(monkeypatch):
    labels = columns((0, 12), (1, 12))
    front = inputs_of(scene([3.0, 3.0]), [0, 1], labels)
    behind = scene([3.0, 3.0])
    behind.means[1] *= 2.0  # the object: where it was on the screen, twice as far and as large
    behind.log_scales[1] += torch.log(torch.tensor(2.0))
    hidden = inputs_of(behind, [0, 1], labels)
    loss = SilhouetteLoss()
    assert float(loss.value(hidden)) < float(loss.value(front))
    monkeypatch.setattr(silhouette, "TAU", 1e9)  # nothing is ever taken for hidden
    assert float(loss.value(hidden)) == pytest.approx(float(loss.value(front)), rel=1e-4)


def test_surface_that_was_seen_as_the_objects_does_not_count_where_another_object_covers_it():
    surfels, labels = scene([3.0, 2.98]), columns((1, 8), (2, 6), (0, 10))  # the second a little before the first
    alone = draw(surfel_inputs(surfels[torch.tensor([0])], CAMERA), CAMERA)
    size, points = 0.1, lift(alone.depth, CAMERA)
    seen = (alone.alpha > 0)[:, :12]  # a part of what the second object covers, and none of the rest
    cloud = points[:, :12][seen]
    grid = VisibilityGrid.from_points([(cloud, torch.ones(len(cloud)))], size, torch.zeros(3), 3)
    inputs = replace(inputs_of(surfels, [1, 2], labels), grid=grid)
    count = grid.count(points.view(-1, 3), torch.ones(SIZE * SIZE, dtype=torch.int32)).view(SIZE, SIZE)
    depth = torch.where(alone.median_depth > 0, alone.median_depth, alone.depth)
    free = (labels == 2) & (alone.alpha > 0) & (count >= 3) & (depth > inputs.render.median_depth)
    assert 0 < int(free.sum()) < int(((labels == 2) & (alone.alpha > 0)).sum())
    class_one = counted(alone.alpha, labels, 1)
    second = draw(surfel_inputs(surfels[torch.tensor([1])], CAMERA), CAMERA).alpha
    class_two = counted(second, labels, 2)  # nothing was seen as the second object's
    for wanted, expected in ((0, class_one.sum()), (3, class_one[~free].sum())):
        found = SilhouetteLoss(objects=2, seen=wanted).value(inputs)
        assert float(found) == pytest.approx(float(expected + class_two.sum()) / SIZE**2, rel=1e-5)
    with pytest.raises(ValueError, match="grid"):
        SilhouetteLoss(seen=3).value(replace(inputs, grid=None))


def test_surface_does_not_count_either_where_more_was_seen_of_it_than_of_what_covers_it():
    surfels, labels = scene([3.0, 2.98]), columns((1, 8), (2, 6), (0, 10))
    alone = draw(surfel_inputs(surfels[torch.tensor([0])], CAMERA), CAMERA)
    points = lift(alone.depth, CAMERA)
    shown = alone.alpha > 0
    beside = points[:, 10:12][shown[:, 10:12]]
    layers = [beside + torch.tensor([x, y, z]) for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.1, 0.1)]
    clouds = [(points[shown], 1.0), (torch.cat(layers), 2.0)]  # more of the second in a part
    together = [(torch.cat([c for c, _ in clouds]), torch.cat([torch.full((len(c),), i) for c, i in clouds]))]
    grid = VisibilityGrid.from_points(together, 0.1, torch.full((3,), 0.05), 3)
    inputs = replace(inputs_of(surfels, [1, 2], labels), grid=grid)
    own, other = (
        grid.count(points.view(-1, 3), torch.full((SIZE * SIZE,), i, dtype=torch.int32)).view(SIZE, SIZE)
        for i in (1, 2)
    )
    depth = torch.where(alone.median_depth > 0, alone.median_depth, alone.depth)
    asked = (labels == 2) & shown & (depth > inputs.render.median_depth)
    free = asked & (own >= silhouette.EDGE) & (own >= other)
    assert bool(free.any()) and bool((asked & (own >= silhouette.EDGE) & (own < other)).any())
    second = counted(draw(surfel_inputs(surfels[torch.tensor([1])], CAMERA), CAMERA).alpha, labels, 2).sum()
    found = SilhouetteLoss(objects=2, seen=27).value(inputs)  # never by the object's own voxels alone
    expected = counted(alone.alpha, labels, 1)[~free].sum() + second
    assert float(found) == pytest.approx(float(expected) / SIZE**2, rel=1e-5)


def test_gradients_reach_the_shape_and_the_object_alone():
    surfels = scene([3.0, 3.2])
    names = ("means", "quats", "log_scales", "opacity_logits")
    leaves = {name: getattr(surfels, name).requires_grad_() for name in names}
    SilhouetteLoss().value(inputs_of(surfels, [0, 1], columns((0, 10), (1, 14)))).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None and float(leaf.grad[0].abs().max()) == 0.0, name
    assert all(float(leaves[name].grad[1].abs().max()) > 0.0 for name in ("means", "log_scales", "opacity_logits"))


def test_no_object_is_asked_to_cover_its_mask():
    """A mask that takes in a plinth would else grow spikes behind the plinth's surface, which no photo contradicts."""
    surfels, labels = scene([3.0, 3.2]), columns((0, 4), (1, 20))  # the mask takes in what is before the object
    leaves = [getattr(surfels, name).requires_grad_() for name in ("means", "log_scales", "opacity_logits")]
    beside = draw(surfel_inputs(surfels[torch.tensor([1])], CAMERA), CAMERA).alpha[:, :4]
    assert float(beside.abs().max()) == 0.0
    loss = SilhouetteLoss().value(inputs_of(surfels, [0, 1], labels))
    assert float(loss) == 0.0
    loss.backward()
    assert all(leaf.grad is None or not leaf.grad.any() for leaf in leaves)


def test_objects_take_turns_and_their_mean_is_the_whole():
    surfels, labels = scene([3.0, 3.0, 3.0]), columns((1, 8), (2, 8), (3, 8))
    whole = float(SilhouetteLoss(objects=3).value(inputs_of(surfels, [1, 2, 3], labels)))
    turns = [float(SilhouetteLoss().value(inputs_of(surfels, [1, 2, 3], labels, step))) for step in range(40)]
    assert len({round(turn, 6) for turn in turns}) == 3
    assert sum(sorted({round(turn, 6) for turn in turns})) / 3 == pytest.approx(whole, rel=1e-4)


def test_views_without_objects_and_wrong_options():
    surfels = scene([3.0])
    assert float(SilhouetteLoss().value(inputs_of(surfels, [1], None))) == 0.0
    assert float(SilhouetteLoss().value(inputs_of(surfels, [1], columns((0, 12), (IGNORE, 12))))) == 0.0
    for options, words in (({"objects": 0}, "objects = 0"), ({"seen": 28}, "seen = 28")):
        with pytest.raises(UserError, match=words):
            SilhouetteLoss(**options)
