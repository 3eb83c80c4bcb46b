"""The voxel size from the density of the lifted points (method, section 5; paper 3.4; E8)."""

from __future__ import annotations

import math
import warnings

import numpy as np

MAX_REFERENCE = 400_000  # points searched; a larger cloud is thinned to this many
_LEAST_NEIGHBOURS = 16  # least k / f, so that its rounding stays small


def reference_indices(total: int, k: int, seed: int = 0, max_reference: int = MAX_REFERENCE) -> np.ndarray:
    """Return the sorted int64 indices of all ``total`` points, or of about ``max_reference`` random ones."""
    count = max(max_reference, math.ceil(total * min(1.0, _LEAST_NEIGHBOURS / k)))
    if total <= count:
        return np.arange(total)
    return np.sort(np.random.default_rng(seed).choice(total, size=count, replace=False))


def voxel_size_of_reference(
    reference: np.ndarray, total: int, k: int = 2000, seed: int = 0, num_queries: int = 2000
) -> float:
    """Return s = (k / rho)^(1/3) with rho = k / (4/3 pi d_k^3), so s = (4 pi / 3)^(1/3) d_k (E8); world units.

    reference: [R, 3] float, R >= 1, the points of ``reference_indices`` of a cloud of ``total`` points. k: neighbours;
    seed: selects the queries. Raises ``ValueError`` for an empty cloud; warns and falls back if d_k cannot be measured.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

    if k < 1:
        raise ValueError(f"k must be at least 1, not {k}")
    if len(reference) == 0:
        raise ValueError("an empty cloud has no voxel size")
    reference = np.asarray(reference, dtype=np.float64)
    available = len(reference) - 1  # the query itself is no neighbour
    share = len(reference) / total  # 1 / f
    neighbours = max(1, round(k * share))  # k / f: with k fixed, thinning would enlarge the voxel
    # d grows with the cube root of k; this factor undoes the rounding of k / f.
    rounding = (k * share / neighbours) ** (1 / 3)
    if neighbours > available:
        if available:
            warnings.warn(
                f"the voxel size needs {neighbours} neighbours, but the views show {available}: all are used.",
                stacklevel=2,
            )
        neighbours, rounding = max(available, 1), 1.0
    rng = np.random.default_rng([seed, 1])
    queries = reference[np.sort(rng.choice(len(reference), size=min(num_queries, len(reference)), replace=False))]
    tree = cKDTree(reference)
    wanted = neighbours
    distance = _mean_distance(tree, queries, neighbours)
    while distance == 0.0 and neighbours < available:
        neighbours = min(2 * neighbours, available)
        distance = _mean_distance(tree, queries, neighbours)
    if distance == 0.0:
        # Any size serves a single place; this one scales with the scene.
        size = 1e-3 * (float(np.abs(reference).max()) or 1.0)
        warnings.warn(f"all points of the views coincide, so the voxel size is set to {size:.4g}.", stacklevel=2)
        return size
    if neighbours != wanted:
        warnings.warn(
            f"the {wanted} nearest neighbours coincide, so the voxel size is measured with {neighbours}.", stacklevel=2
        )
        rounding = 1.0
    return (4.0 / 3.0 * math.pi) ** (1 / 3) * distance * rounding  # (E8)


def _mean_distance(tree, queries: np.ndarray, neighbours: int) -> float:
    """Return the mean distance d_k to the k-th nearest neighbour; queries are points of the tree, hence k + 1."""
    if tree.n <= neighbours:
        return 0.0
    distances, _ = tree.query(queries, k=[neighbours + 1], workers=-1)
    return float(distances.sum() / len(queries))
