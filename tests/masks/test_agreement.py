"""Masks that agree in space: what views share wrongly goes, and good masks stay as they are."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from touching_solids import SETTINGS, solids, views

from beags_plugin.assignment.contributions import contributions
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.agreement import AgreedMask, Agreement, agreed_masks, decide
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import render_class_map

COLOURS = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
CAMERAS = views(12)


@pytest.fixture(scope="module")
def scene():
    """The solids, a rasterizer, and exact masks [H, W] of the number of the solid in each view."""
    surfels, owner = solids(COLOURS)
    rasterizer = make_rasterizer("auto")
    exact = [render_class_map(rasterizer, surfels, owner.int(), camera, SETTINGS)[0] for camera in CAMERAS]
    return surfels, owner, rasterizer, exact


def agreed(scene, labels, classes: int = 2, **options) -> tuple[Agreement, list[AgreedMask]]:
    surfels, _, rasterizer, _ = scene
    found = decide(surfels, CAMERAS, labels, rasterizer, SETTINGS, classes)
    return found, list(agreed_masks(found, surfels, CAMERAS, labels, rasterizer, SETTINGS, classes, **options))


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


def test_new_outlines_move_to_edges_of_the_photo_and_narrow_differences_stay(scene):
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
