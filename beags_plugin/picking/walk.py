"""The probability that a random walk over the surface from a Gaussian meets the object first, and the object's border.

After Grady, "Random Walks for Image Segmentation", PAMI 2006, with a leak: in each step a walker stops with a small
probability. Where no mark is near, this moves the border to where few walkers pass.
"""

from __future__ import annotations

import numpy as np

from beags_plugin.picking.dots import dots
from beags_plugin.picking.graph import FLOOR, SHORTEST, SurfaceGraph

# A walk stops with weight LEAK / number of nodes, beside links of at most 1, so that it crosses a share of the scene.
LEAK = 60.0
MOST_LEAK = 0.03  # largest such weight, in scenes of few nodes
MORE_LEAK = 5e-2  # added on the tangent planes of marks beside the object
TOLERANCE = 1e-3  # norm of the residual, over that at the start
MOST_ITERATIONS = 2_000
LEAST_LEVEL, HIGHEST_LEVEL = 0.1, 0.98  # bounds of a border's level
LITTLE, FEW = 0.002, 100  # share of the scene, and number of Gaussians, below both of which a cut is small


def least_size(count: int) -> float:
    """Return the number of Gaussians below which a cut of a scene of ``count`` is small."""
    return min(FEW, LITTLE * count)


class Walker:
    """The walks of one graph. Determinism: no library splits these products over threads."""

    def __init__(self, graph: SurfaceGraph) -> None:
        from scipy.sparse import csr_array

        count = len(graph.nodes)
        first, second = (
            graph.first.astype(np.int32),
            graph.second.astype(np.int32),
        )  # a third faster than int64
        rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
        values = np.concatenate([graph.weights, graph.weights])
        self._graph = graph
        self._links = csr_array((values, (rows, columns)), shape=(count, count))
        self._degree = np.bincount(rows, values, count) + min(LEAK / max(count, 1), MOST_LEAK)

    def potential(
        self, inside: np.ndarray, outside: np.ndarray, excluded: np.ndarray, leaking: np.ndarray
    ) -> np.ndarray:
        """Return the probability p [M] float64 that a walk from a node meets ``inside`` first.

        p is 1 inside, and 0 outside or where no walk arrives. inside, outside, excluded: disjoint [M] bool; no link
        leads to excluded nodes. leaking: [M] bool, nodes with ``MORE_LEAK``. Elsewhere (D + leak - W) p = 0 is solved
        by conjugate gradients, preconditioned by the diagonal.
        """
        free = ~(inside | outside | excluded)
        degree = self._degree - self._links @ excluded.astype(np.float64) + MORE_LEAK * leaking
        p = inside.astype(np.float64)
        residual = np.where(free, self._links @ p, 0.0)
        goal = TOLERANCE**2 * dots(residual, residual)
        scaled = residual / degree
        direction, rho = scaled, dots(residual, scaled)
        for _ in range(MOST_ITERATIONS):
            if not dots(residual, residual) > goal:
                break
            image = np.where(free, degree * direction - self._links @ direction, 0.0)
            step = rho / dots(direction, image)
            p += step * direction
            residual -= step * image
            scaled = residual / degree
            rho, former = dots(residual, scaled), rho
            direction = scaled + (rho / former) * direction
        return p.clip(0.0, 1.0)

    def border_level(self, p: np.ndarray, weights: np.ndarray, part: bool = False) -> float:
        """Return the level t for which {p >= t} has the shortest border for its size, length / sqrt(area).

        The length is the sum of weight times length over the cut links (``graph``). A border grows like the square root
        of the area, so that the quotient favours no size; but noise encloses a few Gaussians with a short border, so
        small sets (``least_size``) do not count where there are larger ones. 0.5 if no p lies between ``LEAST_LEVEL``
        and ``HIGHEST_LEVEL``.

        weights: [P] float64, of the graph's links, 0 to excluded nodes. part: whether there must be a border, so that
        {p >= t} is not everything.
        """
        count = len(p)
        order = np.argsort(-p, kind="stable")
        rank = np.empty(count, np.int64)
        rank[order] = np.arange(count)
        ends = rank[self._graph.first], rank[self._graph.second]
        lengths = weights * self._graph.lengths
        opened = np.bincount(np.minimum(*ends), lengths, count)
        closed = np.bincount(np.maximum(*ends), lengths, count)
        border = np.cumsum(opened - closed)
        quotient = border / np.sqrt(np.cumsum(self._graph.areas[order]))
        there = border > 0.5 * SHORTEST * FLOOR if part else np.ones(count, dtype=bool)  # half the weakest link
        allowed = np.flatnonzero((p[order] >= LEAST_LEVEL) & (p[order] <= HIGHEST_LEVEL) & there)
        if len(allowed) == 0:
            return 0.5
        large = allowed[allowed + 1 >= least_size(count)]
        allowed = large if len(large) else allowed
        best = allowed[np.argmin(quotient[allowed])]
        following = p[order[best + 1]] if best + 1 < count else 0.0
        return float(0.5 * (p[order[best]] + following))  # halfway, so that no node lies exactly at the level
