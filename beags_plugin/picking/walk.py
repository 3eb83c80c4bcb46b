"""How surely a random walk over the surface from each Gaussian meets the object first, and where that ends.

Grady, "Random Walks for Image Segmentation", PAMI 2006, with a leak: a walker ends in each step with a small
probability, as one who has lost the object. Without a mark near a border this pulls it to where few walkers pass.
"""

from __future__ import annotations

import numpy as np

from beags_plugin.picking.dots import dots
from beags_plugin.picking.graph import FLOOR, SHORTEST, SurfaceGraph

LEAK, MORE_LEAK = 2e-3, 5e-2  # beside a link's weight, at most 1; the second on planes of what is beside the object
TOLERANCE = 1e-4  # of the residual's norm
MOST_ITERATIONS = 2_000
LEAST_LEVEL, HIGHEST_LEVEL = 0.1, 0.98  # of a border


class Walker:
    """The walks of one graph. Determinism: no product here is one that a library splits over threads."""

    def __init__(self, graph: SurfaceGraph) -> None:
        from scipy.sparse import csr_array

        count = len(graph.nodes)
        first, second = graph.first.astype(np.int32), graph.second.astype(np.int32)  # a product is a third quicker
        rows, columns = np.concatenate([first, second]), np.concatenate([second, first])
        values = np.concatenate([graph.weights, graph.weights])
        self._graph = graph
        self._links = csr_array((values, (rows, columns)), shape=(count, count))
        self._degree = np.bincount(rows, values, count) + LEAK

    def potential(
        self, inside: np.ndarray, outside: np.ndarray, excluded: np.ndarray, leaking: np.ndarray
    ) -> np.ndarray:
        """Return p [M] float64, 0..1: 1 ``inside``, 0 ``outside`` or where no walk goes, elsewhere the walk's chance.

        inside, outside, excluded: disjoint [M] bool; no link leads to what is excluded. leaking: [M] bool, where a walk
        ends more often, by ``MORE_LEAK``.
        Solves (D + leak - W) p = 0 there by conjugate gradients, preconditioned by the diagonal.
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
        """Return the level t of which {p >= t} has the least border for its size, length / sqrt(area).

        weights: [P] float64, of the graph's links, 0 to what is excluded. part: whether there must be a border, so that
        it is no level that reaches all.

        The length is a sum over cut links of their weight times what each stands for (``graph``).
        The border of a piece of surface grows like the root of its area, so that this prefers no size. 0.5 if no p
        lies between ``LEAST_LEVEL`` and ``HIGHEST_LEVEL``.
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
        there = border > 0.5 * SHORTEST * FLOOR if part else np.ones(count, dtype=bool)  # the weakest link weighs more
        allowed = np.flatnonzero((p[order] >= LEAST_LEVEL) & (p[order] <= HIGHEST_LEVEL) & there)
        if len(allowed) == 0:
            return 0.5
        best = allowed[np.argmin(quotient[allowed])]
        following = p[order[best + 1]] if best + 1 < count else 0.0
        return float(0.5 * (p[order[best]] + following))  # between the two, so that neither is indifferent
