"""Which photos to compare: those whose largest features look alike, and enough others that none is left alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from beags_plugin.system.progress import counted

NEIGHBOURS = 16  # the photos most alike, with which each is compared
IN_ORDER = 2  # and the next ones by name: people walk while they take photos
ALL = 30  # photos, of which all pairs are compared: few photos are far apart, and each pair counts
COARSE = 300  # features of a photo that are looked at first, the largest
RATIO = 0.85  # of the distances to the nearest and the next nearest feature, at most


def likeness(descriptors: Sequence[np.ndarray], progress: Callable[[int, int], None]) -> np.ndarray:
    """Count the features [N, N] int64 that are each other's nearest, and clearly so, for each pair of photos.

    descriptors: of each photo [F, 128], of unit length.
    """
    count = len(descriptors)
    alike = np.zeros((count, count), np.int64)
    for one in counted(range(count), count, progress):
        for other in range(one + 1, count):
            alike[one, other] = alike[other, one] = _agreeing(descriptors[one], descriptors[other])
    return alike


def _agreeing(one: np.ndarray, other: np.ndarray) -> int:
    if min(len(one), len(other)) < 2:
        return 0
    cosine = one @ other.T
    nearest = cosine.argmax(1)
    mutual = cosine.argmax(0)[nearest] == np.arange(len(one))
    best = np.partition(cosine, -2, axis=1)[:, -2:]
    next_best, first = np.sqrt(np.maximum(2 - 2 * best, 0)).T
    return int((mutual & (first < RATIO * next_best)).sum())


def choose_pairs(alike: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs (smaller, larger) to compare, in order.

    They are all pairs of few photos; else the ``NEIGHBOURS`` most alike to each photo, the ``IN_ORDER`` next ones, and
    the branches of the tree that connects all photos by the pairs most alike.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree

    count = len(alike)
    chosen = set()
    for one in range(count):
        order = [other for other in np.argsort(-alike[one], kind="stable").tolist() if other != one]
        for other in [*order[: NEIGHBOURS if count > ALL else count], *range(one + 1, min(count, one + 1 + IN_ORDER))]:
            chosen.add((min(one, other), max(one, other)))
    tree = minimum_spanning_tree(1.0 / (1.0 + alike) * (1 - np.eye(count))).tocoo()
    chosen.update((min(a, b), max(a, b)) for a, b in zip(tree.row.tolist(), tree.col.tolist(), strict=True))
    return sorted(chosen)
