"""Masks that agree in space: what views share wrongly goes, and good masks stay as they are."""

from __future__ import annotations

import math
from contextlib import nullcontext

import numpy as np
import pytest
import torch
from random_surfels import camera_at
from touching_solids import SETTINGS, solids, views

from beags_plugin.assignment.contributions import contributions
from beags_plugin.core.cameras import cropped
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.masks.agreement import SILENT, AgreedMask, Agreement, agreed_masks, decide, is_shifted
from beags_plugin.preparation.agreed import agree
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import render_class_map
from beags_plugin.views.cameras import small_camera

COLOURS = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
CAMERAS = views(12)


@pytest.fixture(scope="module")
def scene():
    """The solids, a rasterizer, and exact masks [H, W] of the number of the solid in each view."""
    surfels, owner = solids(COLOURS)
    rasterizer = make_rasterizer("auto")
    exact = [render_class_map(rasterizer, surfels, owner.int(), camera, SETTINGS)[0] for camera in CAMERAS]
    return surfels, owner, rasterizer, exact


def agreed(scene, labels, classes: int = 2, cameras=CAMERAS, **options) -> tuple[Agreement, list[AgreedMask]]:
    surfels, _, rasterizer, _ = scene
    found = decide(surfels, cameras, labels, rasterizer, SETTINGS, classes)
    return found, list(agreed_masks(found, surfels, cameras, labels, rasterizer, SETTINGS, classes, **options))


VIEW = 6  # It sees both blocks.


def redrawn(scene, given: torch.Tensor, sure: bool) -> AgreedMask:
    """Return the mask of ``VIEW`` if it is contradicted and the Gaussians are those of block 2."""
    surfels, owner, rasterizer, exact = scene
    errors = np.full(len(CAMERAS), 0.02)
    errors[VIEW] = 0.2
    classes, count = (owner == 2).int(), len(owner)
    decided = Agreement(classes, torch.full((count,), sure), errors, np.ones(len(CAMERAS)), np.ones(count))
    labels = [given if view == VIEW else mask for view, mask in enumerate(of(exact, 2))]
    return list(agreed_masks(decided, surfels, CAMERAS, labels, rasterizer, SETTINGS, 2))[VIEW]


def of(exact: list[torch.Tensor], *numbers: int) -> list[torch.Tensor]:
    return [torch.isin(mask, torch.tensor(numbers)).int() for mask in exact]


def wrong(masks: list[AgreedMask], exact: list[torch.Tensor]) -> float:
    """The share of pixels with another class than the exact one."""
    pairs = zip(masks, exact, strict=True)
    return float(np.mean([((mask.labels != true) & (mask.labels != IGNORE)).float().mean() for mask, true in pairs]))


def test_what_most_views_of_a_face_take_in_too_much_is_taken_out_again(scene):
    """Three views of twelve call the low block the object too; its far side is seen by hardly any other."""
    exact, more = of(scene[3], 2), of(scene[3], 1, 2)
    seeing = [5, 6, 7]
    given = [more[view] if view in seeing else exact[view] for view in range(len(CAMERAS))]
    found, masks = agreed(scene, given)
    assert set(found.contradicted) == set(seeing)
    assert wrong(masks, exact) < 0.1 * np.mean([(a != b).float().mean() for a, b in zip(given, exact, strict=True)])
    owner, side = scene[1], scene[0].means[:, 0] < -0.39
    plain = contributions(scene[0], CAMERAS, given, scene[2], SETTINGS, 2).largest()[0]
    assert float(plain[side & (owner == 1)].float().mean()) > 0.9, "no vote was wrong"
    assert float((found.class_ids[owner == 1] == 0).float().mean()) > 0.95
    assert float((found.class_ids[owner == 2] == 1).float().mean()) > 0.95
    for view in set(range(len(CAMERAS))) - set(seeing):
        assert torch.equal(masks[view].labels, given[view])


def test_good_masks_stay_as_they_are(scene):
    exact = of(scene[3], 2)
    found, masks = agreed(scene, exact)
    assert not found.silenced
    assert np.mean([float((mask.changed | mask.doubtful).float().mean()) for mask in masks]) < 0.003


def test_close_ups_in_which_nothing_was_found_are_unlabelled_and_not_background(scene):
    """Seven empty masks of twelve would outvote the others, pixel by pixel."""
    exact = of(scene[3], 2)
    empty = [0, 1, 3, 5, 7, 9, 11]
    given = [torch.zeros_like(mask) if view in empty else mask for view, mask in enumerate(exact)]
    found, masks = agreed(scene, given)
    assert found.silenced == empty and not found.weights[empty].any()
    assert wrong(masks, exact) < 0.01
    assert all(int((mask.labels == 1).sum()) > 0.8 * int(true.sum()) for mask, true in zip(masks, exact, strict=True))


def test_a_view_without_a_mask_gets_one_and_has_no_error(scene):
    exact = of(scene[3], 2)
    found, masks = agreed(scene, [None, *exact[1:]])
    assert np.isnan(found.errors[0]) and found.silenced == []
    assert wrong(masks[:1], exact[:1]) < 0.01 and int((masks[0].labels == 1).sum()) > 0.8 * int(exact[0].sum())


def test_several_objects_keep_their_own(scene):
    exact = scene[3]
    given = [torch.zeros_like(mask) if view == 3 else mask for view, mask in enumerate(exact)]
    found, masks = agreed(scene, given, classes=3)
    assert found.silenced == [3]
    assert float((found.class_ids == scene[1]).float().mean()) > 0.98
    assert wrong(masks, exact) < 0.003


def away(count: int) -> list:
    """Return cameras that see a corner of the floor alone."""
    corners = [(x, y) for x in (1, -1) for y in (1, -1)] * count
    return [camera_at((0.9 * x, 0.9 * y, 0.8), torch.tensor([0.85 * x, 0.85 * y, 0.0]), 96) for x, y in corners[:count]]


def drawn(scene, cameras) -> list[torch.Tensor]:
    """Return exact masks of block 2 in further views."""
    labels = [render_class_map(scene[2], scene[0], scene[1].int(), camera, SETTINGS)[0] for camera in cameras]
    return of(labels, 2)


def test_empty_masks_of_views_that_miss_the_object_are_right_and_stay(scene):
    cameras = [*CAMERAS, *away(4)]
    exact = drawn(scene, cameras)
    assert not any(int(mask.sum()) for mask in exact[-4:])
    found, masks = agreed(scene, exact, cameras=cameras)
    assert found.silenced == [] and np.isnan(found.errors[-4:]).all() and not np.isnan(found.errors[:-4]).any()
    for mask, true in zip(masks[-4:], exact[-4:], strict=True):
        assert torch.equal(mask.labels, true) and not mask.doubtful.any()


def test_views_that_show_nothing_do_not_raise_the_agreement_of_the_others(scene):
    exact = of(scene[3], 2)
    given = [torch.roll(mask, 9, 1) if view in (0, 3, 6, 9) else mask for view, mask in enumerate(exact)]
    cameras = [*CAMERAS, *away(24)]
    alone, _ = agreed(scene, given)
    among, _ = agreed(scene, [*given, *drawn(scene, cameras[12:])], cameras=cameras)
    assert np.nanmean(among.errors) == pytest.approx(np.mean(alone.errors), abs=0.01)


def test_an_object_that_only_shines_into_a_view_is_not_missed_by_its_empty_mask(scene):
    """The camera turns away until no pixel is the object's, but Gaussians at the border have some light."""
    for turn in np.arange(0.3, 1.2, 0.01):
        eye, target = (2.2, 0.0, 1.2), (2.2 - 1.5 * math.cos(turn), 1.5 * math.sin(turn), 0.2)
        camera = camera_at(eye, torch.tensor(target), pixels=96)
        (mask,) = drawn(scene, [camera])
        if not mask.any():
            break
    exact = of(scene[3], 2)
    found, _ = agreed(scene, [*exact, mask], cameras=[*CAMERAS, camera])
    assert np.isnan(found.errors[-1]) and found.silenced == []


def test_an_empty_mask_that_misses_a_small_part_is_wrong_whether_close_ups_follow_or_not(scene):
    """Close-ups hold far more light of the object, from which no whole photo may seem to show nothing of it."""
    for turn in np.arange(0.2, 1.2, 0.01):
        eye, target = (2.2, 0.0, 1.2), (2.2 - 1.5 * math.cos(turn), 1.5 * math.sin(turn), 0.2)
        camera = camera_at(eye, torch.tensor(target), pixels=96)
        (mask,) = drawn(scene, [camera])
        if int(mask.sum()) < 50:
            break
    assert int(mask.sum()) > 20
    close_ups = [
        small_camera(cropped(small_camera(each, (432, 432)), 156, 156, 120, 120), (120, 120)) for each in CAMERAS
    ]
    exact = of(scene[3], 2)
    for further in ([], close_ups, 2 * close_ups):
        given = [*exact, torch.zeros_like(mask), *drawn(scene, further)]
        found, _ = agreed(scene, given, cameras=[*CAMERAS, camera, *further])
        assert found.errors[12] == 1.0 and found.silenced == [12]


def test_a_class_of_which_gaussians_are_not_certain_is_left_out(scene):
    given, block = of(scene[3], 1, 2)[VIEW], of(scene[3], 1)[VIEW] == 1
    doubted, certain = redrawn(scene, given, sure=False), redrawn(scene, given, sure=True)
    assert int((certain.labels[block] == 0).sum()) > 0.8 * int(block.sum()) and not certain.doubtful.any()
    assert torch.equal(doubted.doubtful, certain.changed) and (doubted.labels[doubted.doubtful] == IGNORE).all()
    assert not doubted.changed.any() and int(doubted.doubtful[block].sum()) > 0.8 * int(block.sum())


def test_votes_that_contradict_each_other_are_not_sure(scene):
    """Each view calls half of the low block's pixels the object; all agree on the high block."""
    generator = torch.Generator().manual_seed(0)
    halves = [torch.rand(mask.shape, generator=generator) < 0.5 for mask in scene[3]]
    found, _ = agreed(
        scene, [((mask == 2) | ((mask == 1) & half)).int() for mask, half in zip(scene[3], halves, strict=True)]
    )
    top = (scene[0].means[:, 2] > 0.24) & (scene[1] > 0)
    shares = [float(found.sure[top & (scene[1] == block)].float().mean()) for block in (1, 2)]
    assert shares[0] < 0.2 and shares[1] > 0.9


def test_narrow_differences_stay(scene):
    """A rim of one pixel is finer than Gaussians are; a blot beside the object is not."""
    exact = of(scene[3], 2)[VIEW]
    wide = torch.nn.functional.max_pool2d(exact[None, None].float(), 3, 1, 1)[0, 0].int()
    given = wide.clone()
    given[70:80, 44:54] = 1
    found = redrawn(scene, given, sure=True)
    assert int((wide != exact).sum()) > 100 and not given[69:81, 43:55].all() and not found.labels[70:80, 44:54].any()
    kept = found.labels[wide != exact] == 1
    assert float(kept.float().mean()) > 0.9


def test_the_mask_of_a_view_with_a_wrong_pose_stays_but_for_the_differences(scene):
    exact = of(scene[3], 2)
    given = [torch.roll(exact[0], 6, 1), *exact[1:]]
    found, masks = agreed(scene, given)
    assert found.contradicted == [0] and [mask.misplaced for mask in masks] == [True] + [False] * 11
    labels, both = masks[0].labels, (given[0] == 1) & (exact[0] == 1)
    assert not masks[0].changed.any() and torch.equal(masks[0].doubtful, labels == IGNORE)
    assert torch.equal(labels[labels != IGNORE], given[0][labels != IGNORE])
    assert float((labels[both] == 1).float().mean()) > 0.9
    assert float((labels[given[0] != exact[0]] == IGNORE).float().mean()) > 0.9


def test_a_mask_far_from_where_it_is_drawn_is_not_overruled_if_it_fits_there(scene):
    exact = of(scene[3], 2)
    given = [torch.roll(exact[0], 16, 1), *exact[1:]]
    known = ClassRanks(torch.arange(2))
    stage = lambda _: nullcontext()  # noqa: E731
    labels, report = agree(scene[0], CAMERAS, LabelMaps(given), known, scene[2], SETTINGS, stage)
    assert (report.errors[0] or 0.0) > SILENT and report.misplaced == [0] and report.overruled == []
    assert torch.equal(labels[0] == IGNORE, (labels[0] != given[0])) and report.changed[0] == 0.0


def test_damage_that_views_share_is_no_wrong_pose(scene):
    """Three views take in the block beside, one as much ground below, and one lacks a part."""
    exact, more = of(scene[3], 2), of(scene[3], 1, 2)
    given = [more[view] if view in (5, 6, 7) else mask for view, mask in enumerate(exact)]
    given[1] = ((exact[1] + torch.roll(exact[1], 8, 0)) > 0).int()
    given[9] = exact[9].clone()
    given[9][exact[9].nonzero()[:, 0].median() :] = 0
    found, masks = agreed(scene, given)
    assert {1, 5, 6, 7, 9} <= set(found.contradicted) and not any(mask.misplaced for mask in masks)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ((40, 50, 120, 90), False),  # the mask is as drawn
        ((40, 60, 120, 100), True),
        ((52, 44, 132, 84), True),
        ((40, 50, 135, 90), False),  # the mask takes in a plinth
        ((40, 30, 120, 110), False),  # the mask takes in a blanket
        ((80, 50, 120, 90), False),  # half of it is missing
        ((40, 110, 120, 150), False),  # another thing of the same size
        ((40, 65, 98, 105), False),  # another thing that is smaller
        ((0, 0, 0, 0), False),
    ],
)
@pytest.mark.parametrize("scale", [1, 4])
def test_only_a_shift_is_told_from_damage(given, expected, scale):
    labels = np.zeros((2, 200 * scale, 160 * scale), np.int64)
    for each, (top, left, bottom, right) in zip(labels, (given, (40, 50, 120, 90)), strict=True):
        each[top * scale : bottom * scale, left * scale : right * scale] = 1
    labels[1, 50 * scale, 60 * scale] = IGNORE
    assert is_shifted(*labels) is expected


def test_a_shift_moves_nothing_over_the_border_to_the_other_side():
    given, drawn = np.zeros((2, 100, 160), np.int64)
    given[:, :5] = given[:, 125:] = drawn[:, :20] = drawn[:, 140:] = 1
    assert not is_shifted(given, drawn)


def test_new_outlines_move_to_edges_of_the_photo(scene):
    exact = of(scene[3], 2)
    given = list(exact)
    given[0] = torch.zeros_like(exact[0])
    given[0][40:44, 40:44] = 1
    photo = np.full((*exact[0].shape, 3), 40, np.uint8)
    shifted = np.roll(exact[0].numpy() == 1, 2, axis=1)
    photo[shifted] = 220
    _, plain = agreed(scene, given)
    _, snapped = agreed(scene, given, reach=2, photos=[lambda: photo] * len(CAMERAS))
    near = [int(((masks[0].labels == 1).numpy() != shifted).sum()) for masks in (plain, snapped)]
    assert near[1] < 0.7 * near[0]
