"""Kinds of what is left of an object's error."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks.remaining_error import KINDS, judged, kinds_of, rows

THREE = np.ones((3, 3), np.uint8)


def scene():
    """A square with a thin handle, all of it seen; another object beside it."""
    exact = np.zeros((60, 80), bool)
    exact[20:40, 20:40] = True
    exact[28:31, 40:55] = True
    others = np.zeros_like(exact)
    others[20:40, 8:19] = True
    return exact, np.ones_like(exact), others


def kind_of(predicted, exact, seen, others):
    """Return the only kind of the wrong pixels."""
    kinds = kinds_of(predicted, exact, seen, others)
    (kind,) = (kind for kind, pixels in kinds.items() if pixels.any())
    return kind


def changed(exact, rows, columns, value):
    mask = exact.copy()
    mask[rows, columns] = value
    return mask


@pytest.mark.parametrize(
    ("place", "value", "kind"),
    [
        ((19, slice(25, 35)), True, "rim, ground: too much"),
        ((20, slice(25, 35)), False, "rim, ground: missing"),
        ((slice(25, 35), 19), True, "rim, object: too much"),
        ((slice(50, 54), slice(60, 64)), True, "floater"),
        ((slice(28, 31), slice(46, 52)), False, "thin"),
        ((slice(25, 35), slice(30, 34)), False, "else"),
    ],
)
def test_each_error_is_of_its_kind(place, value, kind):
    exact, seen, others = scene()
    assert kind_of(changed(exact, *place, value), exact, seen, others) == kind


def test_what_lies_deeper_beside_another_object_is_a_contact_and_its_rim_another_kind():
    exact, seen, others = scene()
    kinds = kinds_of(changed(exact, slice(25, 35), slice(15, 20), True), exact, seen, others)
    assert kinds["contact"].sum() == 40 and kinds["rim, object: too much"].sum() == 10
    others[20:40, 12:20] = True
    kinds = kinds_of(changed(exact, slice(25, 35), slice(20, 22), False), exact, seen, others)
    assert kinds["contact"].sum() == 10 and kinds["rim, object: missing"].sum() == 10


def test_missing_surface_that_nobody_saw_is_unseen_wherever_it_lies():
    exact, seen, others = scene()
    seen[:, 30:] = False
    assert kind_of(changed(exact, slice(20, 40), slice(36, 60), False), exact, seen, others) == "unseen"


def test_kinds_part_the_wrong_pixels_and_righting_a_kind_gains_what_it_costs():
    exact, seen, others = scene()
    generator = np.random.default_rng(0)
    band = (cv2.dilate(exact.astype(np.uint8), THREE, iterations=4) > 0) & (generator.uniform(size=exact.shape) < 0.3)
    predicted = exact ^ band
    kinds = kinds_of(predicted, exact, seen, others)
    assert tuple(kinds) == KINDS
    np.testing.assert_array_equal(sum(pixels.astype(int) for pixels in kinds.values()), predicted ^ exact)
    mask = judged("square", changed(exact, 19, slice(25, 35), True), exact, seen, others)
    assert mask.biou + mask.gains["rim, ground: too much"] == 1.0 and mask.gains["thin"] == 0.0
    assert judged("square", exact & False, exact & False, seen, others) is None


def test_a_row_shows_shares_of_wrong_pixels_and_mean_gains():
    exact, seen, others = scene()
    masks = [
        judged("square", changed(exact, 19, slice(25, 35), True), exact, seen, others),
        judged("square", changed(exact, slice(50, 55), slice(60, 66), True), exact, seen, others),
    ]
    (everything, one) = rows("after", masks)
    assert everything.startswith("| after: all | ") and one.startswith("| after: square | ")
    cells = dict(zip(KINDS, [cell.split(", ") for cell in everything.strip("| ").split(" | ")[2:]], strict=True))
    assert cells["rim, ground: too much"][0] == "25" and cells["floater"][0] == "75"
    assert float(cells["floater"][1]) == pytest.approx(50 * masks[1].gains["floater"], abs=0.05)
