"""Which photos are compared."""

from __future__ import annotations

import numpy as np
import pytest

from beags_plugin.posing.pairs import ALL, NEIGHBOURS, choose_pairs, likeness


def unit(rows: np.ndarray) -> np.ndarray:
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def walk():
    """Return descriptors of 40 photos, each of which shows 20 things of a row, six of them new."""
    generator = np.random.default_rng(0)
    things = generator.random((260, 128)) ** 4
    shown = [things[6 * photo : 6 * photo + 20] for photo in range(40)]
    return [unit(generator.permutation(each) + 0.02 * generator.random(each.shape)) for each in shown]


def test_likeness_counts_what_two_photos_share(walk):
    alike = likeness([*walk[:20], np.zeros((0, 128), np.float32)], lambda done, total: None)
    assert (alike == alike.T).all() and not alike[-1].any()
    assert [alike[0, other] for other in (1, 2, 3)] == [14, 8, 2]
    assert alike[0, 4:].max() <= 1


def test_pairs_are_the_most_alike_the_next_and_a_tree(walk):
    alike = likeness(walk, lambda done, total: None)
    pairs = choose_pairs(alike)
    assert len(pairs) == len(set(pairs)) <= 40 * (NEIGHBOURS + 3)
    assert all(one < other for one, other in pairs)
    assert {(i, i + d) for i in range(37) for d in (1, 2, 3)} <= set(pairs)
    few = alike[:ALL, :ALL]
    assert len(choose_pairs(few)) == ALL * (ALL - 1) // 2
