"""Light baked on the triangles of a mesh: measured once at the points of a grid on each, and read between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beags_plugin.sample.meshes import Mesh

Measure = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From surface points [N, 3] and unit normals [N, 3], in the mesh's frame, to their light [N, 3]."""


class LightMap:
    """The light of one mesh that does not move."""

    def __init__(self, mesh: Mesh, spacing: float, measure: Measure) -> None:
        """Measure the light at points at most ``spacing`` apart, world units."""
        self.mesh = mesh
        corners = mesh.vertices[mesh.triangles]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        self._steps = np.maximum(np.ceil(edges.max(axis=1) / spacing), 1.0).astype(np.int64)  # of each triangle's sides
        sizes = (self._steps + 1) ** 2
        self._first = np.cumsum(sizes) - sizes
        self._light = np.zeros((int(sizes.sum()), 3), dtype=np.float32)
        for steps in np.unique(self._steps):
            of = np.flatnonzero(self._steps == steps)
            i, j = np.nonzero(np.add.outer(np.arange(steps + 1), np.arange(steps + 1)) <= steps)
            weights = np.stack([steps - i - j, i, j], axis=1) / steps
            points = np.einsum("sk,tkd->tsd", weights, corners[of]).reshape(-1, 3)
            normals = np.repeat(mesh.face_normals[of], len(i), axis=0)
            places = (self._first[of, None] + i * (steps + 1) + j).ravel()
            self._light[places] = measure(points, normals)

    def read(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the light [N, 3] at surface points [N, 3] that rays along ``directions`` [N, 3] hit first; own frame.

        Points that rounding moved past an edge get the light of the mesh's first corner.
        """
        hit, triangle, places = self.mesh.land(points, directions)
        steps = self._steps[triangle]
        at = np.clip(places, 0.0, 1.0) * steps[:, None]
        i, j = np.minimum(np.floor(at), steps[:, None] - 1.0).astype(np.int64).T
        u, v = at[:, 0] - i, at[:, 1] - j
        far = (u + v > 1.0) & (i + j + 2 <= steps)  # The cell's second triangle, where it lies inside the mesh's.
        row = steps + 1
        start = self._first[triangle] + i * row + j
        base = np.where(far, start + row + 1, start)
        along, across = np.where(far, 1.0 - u, u), np.where(far, 1.0 - v, v)
        first, second = np.where(far, start + 1, start + row), np.where(far, start + row, start + 1)
        light = np.broadcast_to(self._light[0], points.shape).copy()
        light[hit] = (
            self._light[base] * (1.0 - along - across)[:, None]
            + self._light[first] * along[:, None]
            + self._light[second] * across[:, None]
        )
        return light
