"""Several things of one object: those that lie apart become classes, and the masks of all views with them."""

from __future__ import annotations

from contextlib import nullcontext

import numpy as np
import pytest
import torch
from touching_solids import SETTINGS, solids, views

from beags_plugin.core.surfels import Surfels
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.class_ranks import ClassRanks
from beags_plugin.labels.label_maps import LabelMaps
from beags_plugin.masks.agreement import decide
from beags_plugin.masks.separate_things import Things, parts_of, separate, separated_labels
from beags_plugin.preparation.agreed import agree
from beags_plugin.rasterizers import make_rasterizer
from beags_plugin.rasterizers.rendering import render_class_map

COLOURS = {0: (0.6, 0.6, 0.6), 1: (0.8, 0.2, 0.2), 2: (0.2, 0.3, 0.8)}
CAMERAS = views(12)
SHIFTS = {1: (-0.45, -0.4, 0.0), 2: (0.35, -0.25, 0.0), 3: (-0.4, 0.55, 0.0)}
"""Shifts of the low block, the high one, and a second low one (3), so that none touches another."""


def taken(surfels: Surfels, chosen: torch.Tensor, shift: tuple[float, float, float]) -> list[torch.Tensor]:
    fields = [getattr(surfels, name)[chosen] for name in ("quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest")]
    return [surfels.means[chosen] + torch.tensor(shift), *fields]


@pytest.fixture(scope="module")
def scene():
    """Three things apart on a floor, the owner of each Gaussian, a rasterizer, and exact masks of each view."""
    surfels, owner = solids(COLOURS)
    parts = [taken(surfels, owner == min(number, 2) if number < 3 else owner == 1, SHIFTS[number]) for number in SHIFTS]
    parts = [taken(surfels, owner == 0, (0.0, 0.0, 0.0)), *parts]
    numbers = torch.cat([torch.full((len(part[0]),), number) for number, part in enumerate(parts)])
    apart = Surfels(*(torch.cat(each) for each in zip(*parts, strict=True)))
    rasterizer = make_rasterizer("auto")
    exact = [render_class_map(rasterizer, apart, numbers.int(), camera, SETTINGS)[0] for camera in CAMERAS]
    return apart, numbers, rasterizer, exact


def matched(numbers: torch.Tensor, class_ids: torch.Tensor) -> dict[int, int]:
    """The class that most Gaussians of each thing have."""
    return {int(each): int(class_ids[numbers == each].mode().values) for each in numbers.unique()}


def test_three_things_apart_become_three_classes_in_all_masks(scene):
    surfels, numbers, rasterizer, exact = scene
    given = [(mask > 0).int() for mask in exact]
    given[3] = torch.zeros_like(given[3])  # The network has missed the things there.
    given[4] = (exact[4] == 2).int()  # It took one of them there.
    given[5] = None
    known, stage = ClassRanks(torch.arange(2)), lambda name: nullcontext()
    masks, report = agree(surfels, CAMERAS, LabelMaps(given), known, rasterizer, SETTINGS, stage, things=3)
    assert report.things == Things(3, 3, 0) and not report.things.sentence()
    found = separate(decide(surfels, CAMERAS, given, rasterizer, SETTINGS, 2), surfels, 3)
    of = matched(numbers, found.agreement.class_ids)
    assert of[0] == 0 and sorted(of.values()) == [0, 1, 2, 3] and of[2] == 1, "the largest comes first"
    right = torch.tensor([of[each] for each in range(4)])
    assert float((found.agreement.class_ids == right[numbers]).float().mean()) > 0.98
    for view, (mask, true) in enumerate(zip(masks, exact, strict=True)):
        wanted = right[true.long()]
        wrong = (mask != wanted) & (mask != IGNORE)
        assert float(wrong.float().mean()) < (0.01 if view in (3, 4, 5) else 0.003), view
        for each in (1, 2, 3):
            assert int(((mask == each) & (wanted == each)).sum()) > 0.8 * int((wanted == each).sum()), (view, each)


def test_things_beyond_those_asked_for_are_background_and_said(scene):
    surfels, numbers, rasterizer, exact = scene
    given = [(mask > 0).int() for mask in exact]
    found = separate(decide(surfels, CAMERAS, given, rasterizer, SETTINGS, 2), surfels, 2)
    assert found.things == Things(2, 2, 1)
    of = matched(numbers, found.agreement.class_ids)
    assert of[2] == 1 and sorted([of[1], of[3]]) == [0, 2]
    left_out = 1 if of[1] == 0 else 3
    for mask, true in zip(separated_labels(found, surfels, CAMERAS, given, rasterizer, SETTINGS), exact, strict=True):
        assert mask is not None and float((mask[true == left_out] == 0).float().mean()) > 0.8
    assert found.things.sentence() == "One more separate thing was found and became background: ask for 3."
    assert Things(2, 2, 2).sentence() == "2 more separate things were found and became background: ask for 4."


def test_things_that_touch_stay_one_and_that_is_said():
    surfels, owner = solids(COLOURS)
    rasterizer = make_rasterizer("auto")
    given = [(render_class_map(rasterizer, surfels, owner.int(), camera, SETTINGS)[0] > 0).int() for camera in CAMERAS]
    found = separate(decide(surfels, CAMERAS, given, rasterizer, SETTINGS, 2), surfels, 2)
    assert found.things == Things(2, 1, 0)
    assert found.things.sentence().startswith("Only one separate thing was found, not 2: click on things that touch")


def test_a_streak_links_nothing_and_parts_do_not_depend_on_scale_or_order():
    generator = np.random.default_rng(0)
    centres = np.concatenate([generator.normal(0, 0.1, (200, 3)) + [x, 0, 0] for x in (0.0, 2.0)])
    deviations = np.full(400, 0.03)
    centres[7], deviations[7] = (1.0, 0.0, 0.0), 3.0  # a streak between both
    parts = parts_of(centres, deviations)
    sides = [np.bincount(parts[side]).max() for side in (slice(0, 200), slice(200, 400))]
    assert min(sides) > 170 and np.bincount(parts[:200]).argmax() != np.bincount(parts[200:]).argmax()
    order = generator.permutation(400)
    again = parts_of(1e3 * centres[order], 1e3 * deviations[order])
    same = parts[order][:, None] == parts[order][None]
    assert np.array_equal(same, again[:, None] == again[None])
    assert len(parts_of(centres[:1], deviations[:1])) == 1 and len(parts_of(centres[:0], deviations[:0])) == 0
