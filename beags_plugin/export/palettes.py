"""Quantise many values to tables of few: numbers, and the higher bands of Gaussians.

Determinism: everything runs on one thread, from a fixed start.
"""

from __future__ import annotations

import numpy as np

_ROUNDS = 30  # rounds of Lloyd's algorithm on numbers; more change the fourth digit of the error
_BINS = 4096
_ALL = 1024  # number of Gaussians up to which each has an entry of its own
_SHARE = 4  # Gaussians per palette entry above that number
_MOST = 65536  # entries that two bytes can index
_BATCH = 8192
_PASSES = 10


def table_of(values: np.ndarray, count: int) -> np.ndarray:
    """Return ``count`` numbers in ascending order, float32 precision, that stand for values [M] (k-means by Lloyd).

    Fewer distinct values are kept, the last of them repeated.
    """
    distinct = np.unique(values.astype(np.float32))
    if len(distinct) <= count:
        return np.concatenate([distinct, np.repeat(distinct[-1:], count - len(distinct))])
    ordered = np.sort(values)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # The start: the entries of a large optimal table are as dense as the cube root of the values' density (Panter and
    # Dite).
    members, edges = np.histogram(ordered, _BINS)
    shares = np.concatenate([[0.0], np.cumsum(np.cbrt(members))])
    table = np.interp((np.arange(count) + 0.5) / count, shares / shares[-1], edges)
    for _ in range(_ROUNDS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (table[1:] + table[:-1]) / 2), [len(ordered)]])
        members = np.diff(ends)
        table = np.where(members > 0, np.diff(sums[ends]) / np.maximum(members, 1), table)
    return np.sort(table).astype(np.float32)


def nearest(table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the indices of the entries of an ascending table that are nearest to values of any shape."""
    middles = (table[1:].astype(np.float64) + table[:-1]) / 2
    return np.searchsorted(middles, values)


def palette_of(vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (palette [K, D], the entry [N] int64 of each of vectors [N, D]); up to 1,024 vectors are all kept."""
    if len(vectors) <= _ALL:
        return vectors, np.arange(len(vectors))
    from sklearn.cluster import MiniBatchKMeans
    from threadpoolctl import threadpool_limits

    count = min(max(_ALL, len(vectors) // _SHARE), _MOST)
    clusters = MiniBatchKMeans(
        count,
        init="random",
        n_init=1,  # pyright: ignore[reportArgumentType]  (or "auto")
        random_state=0,
        batch_size=_BATCH,
        max_iter=_PASSES,
        reassignment_ratio=0.0,
    )
    with threadpool_limits(1):
        labels = np.asarray(clusters.fit_predict(vectors.astype(np.float32)))
    return np.asarray(clusters.cluster_centers_, np.float64), labels.astype(np.int64)
