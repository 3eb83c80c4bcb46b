"""Choice of the pairs of photos to match: photos that look alike, and enough others to connect all photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from beags_plugin.system.progress import counted

NEIGHBOURS = 16  # most similar photos that each photo is compared with
IN_ORDER = 2  # next photos by name that it is compared with too: people walk while they take photos
ALL = 30  # photos up to which all pairs are compared: few photos are far apart, and each pair counts
COARSE = 300  # largest features of a photo, by which likeness is measured
AT_ONCE = 16  # photos compared with one in one step
RATIO = 0.85  # largest ratio of the distances to the nearest and the next nearest feature


def likeness(descriptors: Sequence[np.ndarray], progress: Callable[[int, int], None]) -> np.ndarray:
    """Return [N, N] int64: for each pair of photos, the features that are each other's nearest by a clear margin.

    descriptors: [F, 128] of each photo, of unit length.
    """
    count, most = len(descriptors), max(1, *map(len, descriptors))
    table = np.zeros((count, most, 128), np.float32)  # missing features are equally far from all
    for rows, own in zip(table, descriptors, strict=True):
        rows[: len(own)] = own
    alike = np.zeros((count, count), np.int64)
    for one in counted(range(count), count, progress):
        for first in range(one + 1, count, AT_ONCE):
            others = table[first : first + AT_ONCE]
            cosine = (table[one] @ others.reshape(-1, 128).T).reshape(most, -1, most)
            nearest = cosine.argmax(2)  # the other photo's nearest feature to each of this one
            mutual = np.take_along_axis(cosine.argmax(0).T, nearest, 0) == np.arange(most)[:, None]
            best = cosine.max(2)
            np.put_along_axis(cosine, nearest[..., None], 0, 2)
            clear = 1 - best < RATIO**2 * (1 - cosine.max(2))  # halves of squared distances
            alike[one, first : first + AT_ONCE] = (mutual & clear).sum(0)
    return alike + alike.T


def choose_pairs(alike: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs (smaller, larger) to compare, in order.

    Up to ``ALL`` photos these are all pairs. Otherwise they are, for each photo, the ``NEIGHBOURS`` most similar ones
    and the ``IN_ORDER`` next ones, and the edges of the tree that connects all photos by the most similar pairs.
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
