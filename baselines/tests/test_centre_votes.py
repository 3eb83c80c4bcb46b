"""SAGD's votes of centres and its decomposition, with numbers worked out by hand, and what the votes' rules count."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from drawn_discs import camera, discs
from trained_scenes import trained_scene

from beags_baselines import centre_votes
from beags_baselines.centre_votes import decompose, members
from beags_baselines.pixels import project_directions
from beags_baselines.sagd import Decomposition, SagdRefiner
from beags_plugin.core.cameras import Camera
from beags_plugin.core.lifting import project
from beags_plugin.core.rotations import quat_product, rotation_from_quat
from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE

SIZE = 41


def mask(*ids: int, height: int = 8) -> torch.Tensor:
    return torch.tensor(ids, dtype=torch.int32).repeat(height, 1)


def votes(points: torch.Tensor, masks: list, rule: str, shifts: list | None = None, **options) -> list[int]:
    """Votes of views that look alike, each moved to the side by a number of pixels."""
    views = []
    for shift in shifts or [0] * len(masks):
        view = camera(8)
        K = view.K.clone()
        K[0, 2] += shift
        views.append(Camera(view.viewmat, K, view.width, view.height))
    return members(points, views, masks, 5, votes=rule, **options).tolist()


def points(*columns: float, depths=None) -> torch.Tensor:
    return discs(8, [(column + 0.5, 4.5) for column in columns], 1.0, 0.5, depths).means


def test_members_lie_in_the_mask_in_more_than_seven_of_ten_views():
    """The object is in columns 2 and 3, in two views in 3 alone, in the last at both ends."""
    masks = [mask(0, 0, 1, 1, 0, 0, 0, 1)] * 7 + [mask(0, 0, 0, 1, 0, 0, 0, 0)] * 2 + [mask(0, 0, 1, 1, 0, 0, 0, 0)]
    # eight of ten; seven (column 7); behind the object in all ten, hidden by it; behind the camera
    where = points(2, 7, 3, 3, depths=[1.0, 1.0, 9.0, -1.0])
    for rule in ("seen", "all"):
        assert votes(where, masks, rule) == [1, 0, 1, 0]
        assert votes(where, masks, rule, threshold=0.69) == [1, 1, 1, 0], "seven are enough below 0.7"
        assert votes(where, masks, rule, threshold=0.8) == [0, 0, 1, 0], "eight are not more than 0.8"


def test_the_views_that_a_share_is_of():
    """The point is out of the picture in three of ten views; then in the picture, but nobody shows the object there."""
    masks = [mask(0, 0, 0, 0, 0, 0, 0, 1)] * 10
    away = [0] * 7 + [1] * 3
    assert votes(points(7), masks, "all", away) == [0]
    assert votes(points(7), masks, "seen", away) == [1]
    masks[7:] = [mask(0, 0, 0, 0, 0, 0, 0, 0)] * 3
    assert votes(points(7), masks, "all") == [0]
    assert votes(points(7), masks, "seen") == [1]


def test_larger_shares_win_and_ties_go_to_the_lower_id():
    """Object 4, which the first view alone shows, has all of its votes in column 0; 3 has all of its in column 1."""
    masks = [mask(4, 2, 0, 0, 0, 0, 0, 0), mask(3, 3, 0, 0, 0, 0, 0, 0), mask(2, 3, 0, 0, 0, 0, 0, 0)]
    found = votes(points(0, 1), masks, "seen", threshold=0.4)
    assert found == [4, 3]
    assert votes(points(0), [mask(4, 0, 0, 0, 0, 0, 0, 0), mask(3, 0, 0, 0, 0, 0, 0, 0)], "seen") == [3]


def test_unlabelled_pixels_and_views_have_no_vote():
    i = IGNORE
    masks = [mask(1, 1, 0, 0, 0, 0, 0, 0)] * 3 + [mask(i, 1, 0, 0, 0, 0, 0, 0)] * 2 + [mask(*[i] * 8)] * 5
    masks.append(mask(0, 0, 1, 0, 0, 0, 0, 0))
    for rule in ("seen", "all"):  # three of four; five of six
        assert votes(points(0, 1), masks, rule) == [1, 1]
        assert votes(points(0, 1), masks, rule, threshold=0.76) == [0, 1]
    assert votes(points(0), [mask(*[i] * 8)], "all") == [0]


def disc(column: float, row: float, sigma_x: float, sigma_y: float, depth: float = 1.0, turn: float = 0.0) -> Surfels:
    """A disc that faces ``camera(SIZE)``, its deviations in pixels; ``turn`` quarters of a circle in its own plane."""
    inputs = discs(SIZE, [(column + 0.5, row + 0.5)], 1.0, 0.5, [depth])
    logs = (torch.tensor([[sigma_x, sigma_y]]).double() / 100.0 * abs(depth)).log()
    half = turn * math.pi / 4
    quat = torch.tensor([[math.cos(half), 0.0, 0.0, math.sin(half)]]).double()
    rest = torch.zeros(1, 0, 3).double()
    return Surfels(inputs.means, quat, logs, inputs.opacity_logits, inputs.colors, rest)


def decomposed(surfels: Surfels, columns: range, ids: int = 1, labels=None) -> tuple[Surfels, list[int]]:
    if labels is None:
        labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
        labels[:, columns.start : columns.stop] = 1
    found, changed = decompose(surfels, torch.full((len(surfels),), ids), camera(SIZE), labels)
    return found, changed.tolist()


@pytest.mark.parametrize("turn", [0.0, 2.0])  # half a turn gives the major axis the other sign
@pytest.mark.parametrize("depth", [1.0, 3.0])
@pytest.mark.parametrize(("columns", "center"), [(range(23), 20 - 1.84615), (range(18, SIZE), 20 + 1.84615)])
def test_a_disc_is_drawn_into_the_mask(columns, center, depth, turn):
    """Ends 14 and 26, nine of 13 pixels inside: it moves by 0.5 x 4/13 x 3 x 4 pixels and keeps 0.8 x 9/13 of it."""
    before = disc(20, 20, 4, 1, depth, turn)
    after, changed = decomposed(before, columns)
    assert changed == [0]
    xy, z = project(after.means, camera(SIZE))
    torch.testing.assert_close(xy - 0.5, torch.tensor([[center, 20.0]]).double(), atol=1e-5, rtol=0)
    assert float(z) == pytest.approx(depth)
    sigmas = after.log_scales.exp() * 100.0 / depth
    torch.testing.assert_close(sigmas, torch.tensor([[2.21538, 0.55385]]).double(), atol=1e-5, rtol=0)
    inner_end = center + (1 if center < 20 else -1) * 1.5 * 2.21538
    assert round(inner_end) in columns, "the new end lies inside"
    for name in ("quats", "opacity_logits", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(after, name), getattr(before, name))


def test_the_major_axis_is_the_longer_scale_wherever_it_points():
    """A quarter turn with the scales changed over is the same disc; both ends of an upright one lie inside."""
    one, _ = decomposed(disc(20, 20, 4, 1), range(23))
    other, changed = decomposed(disc(20, 20, 1, 4, turn=1.0), range(23))
    assert changed == [0]
    torch.testing.assert_close(other.means, one.means)
    torch.testing.assert_close(other.log_scales, one.log_scales.flip(1))
    upright = disc(20, 20, 1, 4)
    same, changed = decomposed(upright, range(23))
    assert changed == [] and torch.equal(same.means, upright.means)


def test_it_moves_along_its_own_axis_in_space():
    """Turned out of the picture's plane, the disc moves in its own plane, and the picture of its centre inwards."""
    before = disc(20, 20, 8, 1)
    tilt = torch.tensor([[math.cos(0.5), 0.0, math.sin(0.5), 0.0]]).double()  # axis y
    before = replace(before, quats=quat_product(tilt, before.quats))
    after, changed = decomposed(before, range(22))
    assert changed == [0]
    moved = (after.means - before.means)[0]
    axis = rotation_from_quat(before.quats)[0, :, 0]
    assert float((moved / moved.norm() @ axis).abs()) == pytest.approx(1.0)
    assert float(moved[2].abs()) > 0.3 * float(moved[0].abs())
    assert float(project(after.means, camera(SIZE))[0][0, 0]) < 20.0


@pytest.mark.parametrize("columns", [range(10, 30), range(30, 35)])
def test_both_ends_on_one_side_leave_every_bit(columns):
    before = disc(20, 20, 4, 1)
    after, changed = decomposed(before, columns)
    assert changed == [] and all(torch.equal(getattr(after, n), v) for n, v in vars(before).items())


def test_who_is_left_alone():
    whole = [disc(20, 20, 4, 1, depth=-1.0), disc(-3, 20, 4, 1), disc(20, 20, 0.2, 0.1), disc(20, 20, math.inf, 1)]
    for before in whole:  # disc behind the camera; centre outside of the picture; both ends in one pixel; broken
        after, changed = decomposed(before, range(20))
        assert changed == [] and all(torch.equal(getattr(after, n), v) for n, v in vars(before).items())
    assert decomposed(disc(20, 20, 4, 1), range(23), ids=0)[1] == [], "of no object"
    assert decomposed(disc(20, 20, 4, 1), range(23), ids=2)[1] == [], "of another, which is not there"
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    labels[:, :23], labels[:, 25:] = 1, IGNORE
    assert decomposed(disc(20, 20, 4, 1), range(23), labels=labels)[1] == [], "an end whose side is unknown"


def test_unlabelled_pixels_between_the_ends_do_not_count():
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    labels[:, :23], labels[:, 15:19] = 1, IGNORE
    after, _ = decomposed(disc(20, 20, 4, 1), range(23), labels=labels)
    assert float(after.log_scales.exp()[0, 0]) * 100 == pytest.approx(4 * 0.8 * 5 / 9)


def test_members_of_several_objects_at_once_and_one_by_one():
    """Each by the mask of its own object; longer and shorter ones together are as each alone."""
    labels = torch.zeros(SIZE, SIZE, dtype=torch.int32)
    labels[:, :18], labels[:, 18:] = 1, 2
    parts = [disc(20, 12, 6, 1), disc(16, 20, 3, 2), disc(18, 25, 4, 1), disc(9, 30, 1, 1)]
    together = Surfels(*(torch.cat(values) for values in zip(*(vars(each).values() for each in parts), strict=True)))
    ids = torch.tensor([2, 1, 2, 1])
    after, changed = decompose(together, ids, camera(SIZE), labels)
    assert changed.tolist() == [0, 1, 2]
    for index, part in enumerate(parts):
        alone, _ = decompose(part, ids[index : index + 1], camera(SIZE), labels)
        assert torch.equal(alone.means[0], after.means[index])
        assert torch.equal(alone.log_scales[0], after.log_scales[index])


@pytest.mark.parametrize(("interval", "views"), [(1, [0, 1, 2, 3, 5, 6, 7, 8]), (3, [0, 3, 7]), (20, [0]), (-1, [])])
def test_every_so_many_views_with_masks_decompose(interval, views, monkeypatch):
    """The members of a view are those that the views before it left."""
    scene, asked, left = trained_scene(), [], []
    scene.labels[4][:] = IGNORE

    def spied(surfels, class_ids, camera, labels):
        asked.append(next(place for place, each in enumerate(scene.labels) if each is labels))
        assert not left or surfels is left[-1]
        after, changed = decompose(surfels, class_ids, camera, labels)
        left.append(after)
        return after, changed

    monkeypatch.setattr(centre_votes, "decompose", spied)
    edit = Decomposition(scene, SagdRefiner(gd_interval=interval)).last_edit()
    assert asked == views and (edit is None) == (not views)
    if edit is not None:
        assert edit.edited is not None and edit.edited.surfels is left[-1]
        assert not torch.equal(left[-1].means, scene.surfels().means)


def test_threads_change_no_bit(for_threads):
    count, generator = 50_000, torch.Generator().manual_seed(0)
    xy = 0.4 * torch.rand(count, 2, generator=generator) - 0.2
    surfels = Surfels(
        torch.cat([xy, 1.0 + torch.rand(count, 1, generator=generator)], dim=1),
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 2, generator=generator) - 4.0,
        torch.zeros(count),
        torch.zeros(count, 3),
        torch.zeros(count, 0, 3),
    )
    labels = torch.randint(4, (SIZE, SIZE), generator=generator).int()
    masks = [labels, torch.full_like(labels, 2)]

    def run() -> list[torch.Tensor]:
        class_ids = members(surfels.means, [camera(SIZE)] * 2, masks, 4, 0.4)
        after, changed = decompose(surfels, class_ids, camera(SIZE), labels)
        assert len(changed) > 10_000
        return [class_ids, after.means, after.log_scales, changed]

    assert all(torch.equal(first, each) for first, *rest in zip(*for_threads(run), strict=True) for each in rest)


def test_directions_project_as_their_points_do():
    view = replace(camera(SIZE), K=camera(SIZE).K + torch.tensor([[0, 3.0, 1], [0, 7, -2], [0, 0, 0]]).double())
    generator = torch.Generator().manual_seed(0)
    where = torch.rand(50, 3, generator=generator, dtype=torch.float64) * 0.3 + torch.tensor([-0.15, -0.15, 1.0])
    directions = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    step = 1e-6
    expected = (project(where + step * directions, view)[0] - project(where - step * directions, view)[0]) / (2 * step)
    torch.testing.assert_close(project_directions(directions, where, view), expected, rtol=1e-6, atol=1e-5)
    aside = project_directions(directions[:1], torch.tensor([[30.0, 0.0, 1.0]]).double(), view)
    nearer = project_directions(directions[:1], torch.tensor([[1.3 * SIZE / 200, 0.0, 1.0]]).double(), view)
    torch.testing.assert_close(aside, nearer)
