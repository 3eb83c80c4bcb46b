"""Degraded masks: wrong near boundaries, in pieces or altogether, as seed and view decide."""

from __future__ import annotations

import numpy as np
import pytest

from beags_plugin.sample.degrade import (
    PRESETS,
    Degradation,
    degrade_mask,
    dropped_views,
    resolve_degradation,
    roughen_rims,
    swap_pieces,
)
from beags_plugin.system.errors import UserError


@pytest.fixture(scope="module")
def labels(scene):
    return np.kron(scene[2][2].labels, np.ones((2, 2), np.uint8))


def test_rims_move_only_near_boundaries(labels):
    amplitude = 2.5
    found = roughen_rims(labels, amplitude, seed=0, view="a")
    changed = np.argwhere(found != labels)
    assert 0.005 < len(changed) / labels.size < 0.15
    reach = amplitude + np.sqrt(0.5)
    for row, column in changed:
        rows, columns = np.nonzero(labels == found[row, column])
        assert np.hypot(rows - row, columns - column).min() <= reach
    assert np.array_equal(roughen_rims(labels, 0.0, 0, "a"), labels)


def test_swaps_are_one_connected_piece_of_an_object(labels):
    from scipy import ndimage

    found = swap_pieces(labels, 8, 0.5, seed=4, view="b")
    swapped = np.unique(labels[found != labels])
    assert 0 < len(swapped) < 7 and 0 not in swapped
    for class_id in swapped:
        piece = (labels == class_id) & (found != labels)
        assert ndimage.label(piece)[1] == 1 and len(np.unique(found[piece])) == 1
        assert piece.sum() <= 0.7 * np.count_nonzero(labels == class_id)


def test_swaps_go_to_objects_and_to_the_background(labels):
    targets = []
    for view in "abcdefgh":
        found = swap_pieces(labels, 8, 1.0, 0, view)
        targets += [found[(labels == i) & (found != labels)][0] for i in np.unique(labels[found != labels])]
    assert 0.25 < np.mean([t == 0 for t in targets]) < 0.75
    assert len(set(targets)) > 4


def test_dropped_views():
    names = [f"v{i}" for i in range(40)]
    dropped = dropped_views(names, 0, 0.2)
    assert len(dropped) == 8 and dropped < set(names)
    assert dropped == dropped_views(names[::-1], 0, 0.2) != dropped_views(names, 1, 0.2)
    assert len(dropped_views(names, 0, 1.0)) == 39  # one mask at least is left
    assert dropped_views(names, 0, 0.0) == set()


def test_degradation_depends_on_seed_and_view_alone(labels):
    strong = PRESETS["strong"]
    first = degrade_mask(labels, 8, strong, 0, "a")
    assert np.array_equal(first, degrade_mask(labels, 8, strong, 0, "a"))
    assert not np.array_equal(first, degrade_mask(labels, 8, strong, 0, "b"))
    assert not np.array_equal(first, degrade_mask(labels, 8, strong, 1, "a"))
    assert np.array_equal(labels, degrade_mask(labels, 8, PRESETS["none"], 0, "a"))
    assert first.dtype == labels.dtype


def test_presets_grow(labels):
    wrong = {n: np.mean([degrade_mask(labels, 8, p, 0, v) != labels for v in "abcdef"]) for n, p in PRESETS.items()}
    assert wrong["none"] == 0.0 < wrong["mild"] < wrong["strong"] < 0.2
    with pytest.raises(UserError, match="mild"):
        resolve_degradation("wild")
    with pytest.raises(UserError, match="swapped"):
        resolve_degradation(Degradation(swapped=1.5))
