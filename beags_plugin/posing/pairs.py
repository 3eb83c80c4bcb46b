"""Which photos to compare: those whose largest features look alike, and enough others that none is left alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from beags_plugin.system.progress import counted

NEIGHBOURS = 16  # the photos most alike, with which each is compared
IN_ORDER = 2  # and the next ones by name: people walk while they take photos
ALL = 30  # photos, of which all pairs are compared: few photos are far apart, and each pair counts
COARSE = 300  # features of a photo that are looked at first, the largest
AT_ONCE = 16  # photos compared with one
RATIO = 0.85  # of the distances to the nearest and the next nearest feature, at most


def likeness(descriptors: Sequence[np.ndarray], progress: Callable[[int, int], None]) -> np.ndarray:
    """Count the features [N, N] int64 that are each other's nearest, and clearly so, for each pair of photos.

    descriptors: of each photo [F, 128], of unit length.
    """
    count, most = len(descriptors), max(1, *map(len, descriptors))
    table = np.zeros((count, most, 128), np.float32)  # what is missing is equally far from all
    for rows, found in zip(table, descriptors, strict=True):
        rows[: len(found)] = found
    alike = np.zeros((count, count), np.int64)
    for one in counted(range(count), count, progress):
        for first in range(one + 1, count, AT_ONCE):
            others = table[first : first + AT_ONCE]
            cosine = (table[one] @ others.reshape(-1, 128).T).reshape(most, -1, most)
            nearest = cosine.argmax(2)  # of the other's features, for each of ours
            mutual = np.take_along_axis(cosine.argmax(0).T, nearest, 0) == np.arange(most)[:, None]
            best = cosine.max(2)
            np.put_along_axis(cosine, nearest[..., None], 0, 2)
            clear = 1 - best < RATIO**2 * (1 - cosine.max(2))  # halves of squared distances
            alike[one, first : first + AT_ONCE] = (mutual & clear).sum(0)
    return alike + alike.T


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
