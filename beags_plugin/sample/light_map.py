"""Light baked on the triangles of a mesh: measured once at the points of a grid on each, and interpolated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from beags_plugin.sample.meshes import Mesh
from beags_plugin.sample.solids import dot

FLAT = 0.77  # least cosine between the normals of faces whose common edge is smooth

Measure = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of surface points [N, 3] and unit normals [N, 3], in the mesh's frame; returns their light [N, 3]."""


class LightMap:
    """The light of one mesh that does not move."""

    def __init__(self, mesh: Mesh, spacing: float, measure: Measure) -> None:
        """Measure the light at points at most ``spacing`` apart, world units."""
        self.mesh = mesh
        corners = mesh.vertices[mesh.triangles]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        # _steps holds the number of steps into which each triangle's sides are divided.
        self._steps = np.maximum(np.ceil(edges.max(axis=1) / spacing), 1.0).astype(np.int64)
        sizes = (self._steps + 1) ** 2
        self._first = np.cumsum(sizes) - sizes
        self._light = np.zeros((int(sizes.sum()), 3), dtype=np.float32)
        smooth = smooth_normals(mesh)
        for steps in np.unique(self._steps):
            of = np.flatnonzero(self._steps == steps)
            i, j = np.nonzero(np.add.outer(np.arange(steps + 1), np.arange(steps + 1)) <= steps)
            weights = np.stack([steps - i - j, i, j], axis=1) / steps
            points = np.einsum("sk,tkd->tsd", weights, corners[of]).reshape(-1, 3)
            normals = np.einsum("sk,tkd->tsd", weights, smooth[of]).reshape(-1, 3)
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            places = (self._first[of, None] + i * (steps + 1) + j).ravel()
            self._light[places] = measure(points, normals)

    def read(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the light [N, 3] at surface points [N, 3] that rays along ``directions`` [N, 3] hit first.

        Both are in the mesh's frame. Points that rounding moved past an edge get the light of the mesh's first corner.
        """
        hit, triangle, weights = self.mesh.land(points, directions)
        light = np.broadcast_to(self._light[0], points.shape).copy()
        light[hit] = self.at(triangle, weights)
        return light

    def at(self, triangle: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Return the light [N, 3] on triangles [N], at weights [N, 2] of their corners 1 and 2."""
        steps = self._steps[triangle]
        place = np.clip(weights, 0.0, 1.0) * steps[:, None]
        cell = np.minimum(place.astype(np.int64), steps[:, None] - 1)
        (i, j), (u, v) = cell.T, (place - cell).T
        far = (u + v > 1.0) & (i + j + 2 <= steps)  # the cell's second half, where it lies inside the triangle
        row = steps + 1
        start = self._first[triangle] + i * row + j
        base = np.where(far, start + row + 1, start)
        # From the base one step lies along the first side and one along the second, forwards or, from afar, backwards.
        first, second = np.where(far, start + 1, start + row), np.where(far, start + row, start + 1)
        along, across = np.where(far, 1.0 - u, u)[:, None], np.where(far, 1.0 - v, v)[:, None]
        light = self._light
        return light[base] + along * (light[first] - light[base]) + across * (light[second] - light[base])


def smooth_normals(mesh: Mesh) -> np.ndarray:
    """Return unit normals [T, 3, 3] at each triangle's corners: means over the triangles that meet there nearly flat.

    Turned shapes with flat faces then look round, and edges stay sharp.
    """
    corners, faces = mesh.vertices[mesh.triangles], np.arange(len(mesh.triangles))
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    _, vertex = np.unique(mesh.vertices.round(9), axis=0, return_inverse=True)
    vertex = vertex.ravel()[mesh.triangles].ravel()
    meeting = sparse.csr_matrix((np.ones(len(vertex)), (vertex, np.repeat(faces, 3))))[vertex].tocoo()
    flat = dot(mesh.face_normals[meeting.row // 3], mesh.face_normals[meeting.col]) > FLAT
    row, column = meeting.row[flat], meeting.col[flat]
    normals = np.zeros((len(vertex), 3))
    np.add.at(normals, row, areas[column, None] * mesh.face_normals[column])
    return (normals / np.linalg.norm(normals, axis=1, keepdims=True)).reshape(-1, 3, 3)
