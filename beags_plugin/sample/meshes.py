"""Closed triangle meshes by turning, extruding and sweeping outlines, traced by Open3D.

Open3D finds the triangle that a ray meets, in float32; the point on its plane is computed in float64.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from beags_plugin.sample.solids import dot

SEGMENTS = 64  # segments of a turned shape: a multiple of 8, so that vertices lie on both axes and on the diagonals
Part = tuple[np.ndarray, np.ndarray]
"""vertices [V, 3] float64 and triangles [T, 3] int64 of one closed surface."""


def _quilt(grid: np.ndarray, closed: bool) -> Part:
    """Return the surface over a grid of points [A, B, 3] whose rows are rings; ``closed``: the last joins the first."""
    rows, columns = grid.shape[:2]
    i, j = np.meshgrid(np.arange(rows if closed else rows - 1), np.arange(columns), indexing="ij")
    below, above = i * columns, (i + 1) % rows * columns
    a, b, c, d = below + j, below + (j + 1) % columns, above + (j + 1) % columns, above + j
    triangles = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    vertices = grid.reshape(-1, 3)
    p, q, r = (vertices[triangles[:, k]] for k in range(3))
    cross = np.cross(q - p, r - p)
    triangles = triangles[dot(cross, cross) > 1e-24]  # At a pole, quads are triangles.
    volume = np.sum(dot(p, np.cross(q, r)))
    return vertices, triangles if volume > 0.0 else triangles[:, ::-1]


def lathe(profile: np.ndarray, flat: np.ndarray | None = None) -> Part:
    """Turn a profile [P, 2] of (radius, z), which begins and ends on the axis, about the z axis.

    flat: [P] factors of y, for a shape that is not round.
    """
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    radius, z = profile[:, :1], np.repeat(profile[:, 1:], SEGMENTS, axis=1)
    stretch = np.ones_like(radius) if flat is None else flat[:, None]
    return _quilt(np.stack([radius * np.cos(angle), stretch * radius * np.sin(angle), z], axis=-1), closed=False)


def extrude(outer: np.ndarray, inner: np.ndarray | float, low: float, high: float) -> Part:
    """Extrude the band between two outlines [P, 2] along z from ``low`` to ``high``; inner 0.0: without a hole.

    Without a hole, all of the outline must be visible from (0, 0).
    """
    hole = np.zeros_like(outer) + inner
    rings = [(outer, low), (outer, high), (hole, high), (hole, low)]
    return _quilt(np.stack([np.column_stack([ring, np.full(len(ring), z)]) for ring, z in rings]), closed=True)


def block(x: float, y: float, low: float, high: float) -> Part:
    """Return the box |x| <= x, |y| <= y, low <= z <= high."""
    return extrude(np.array([[x, y], [-x, y], [-x, -y], [x, -y]]), 0.0, low, high)


def sweep(path: np.ndarray, radius: float, around: int = 16) -> Part:
    """Return a round bar along a path [P, 2] of (x, z) in the plane y = 0, flat at its ends."""
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    angle = 2.0 * np.pi * np.arange(around) / around
    out = np.stack([-tangent[:, 1], np.zeros(len(path)), tangent[:, 0]], axis=1)  # normals of the path in its plane
    ring = np.cos(angle)[:, None] * out[:, None] + np.sin(angle)[:, None] * np.array([0.0, 1.0, 0.0])
    centre = np.stack([path[:, 0], np.zeros(len(path)), path[:, 1]], axis=1)[:, None]
    tube = centre + radius * ring
    caps = [np.repeat(centre[end : end + 1], around, axis=1) for end in (0, len(path) - 1)]
    return _quilt(np.concatenate([caps[0], tube, caps[1]]), closed=False)


def moved(part: Part, by: tuple[float, float, float]) -> Part:
    """Return the part moved by a vector."""
    return part[0] + np.array(by), part[1]


class Mesh:
    """A body made of closed parts, which may intersect; a solid for ``scene.Thing``."""

    def __init__(self, *parts: Part) -> None:
        offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
        self.vertices = np.concatenate([vertices for vertices, _ in parts])
        self.triangles = np.concatenate([t + offset for (_, t), offset in zip(parts, offsets[:-1], strict=True)])
        self.bound = float(np.linalg.norm(self.vertices, axis=1).max())
        p, q, r = (self.vertices[self.triangles[:, k]] for k in range(3))
        normals = np.cross(q - p, r - p)
        self.face_normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def caster(self) -> Any:
        """Return Open3D's scene of this mesh alone."""
        return raycaster([(self.vertices, self.triangles)])

    def _cast(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the rays that hit, the triangles that they hit first, and the weights [M, 2] of corners 1 and 2."""
        hits = self.caster.cast_rays(rays(origins, directions))
        triangle = hits["primitive_ids"].numpy()
        hit = np.flatnonzero(triangle < len(self.triangles))
        return hit, triangle[hit].astype(np.int64), hits["primitive_uvs"].numpy()[hit]

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return [N] smallest t > 0 at which rays from outside enter the body, infinity if none."""
        hit, triangle, _ = self._cast(origins, directions)
        normals, corner = self.face_normals[triangle], self.vertices[self.triangles[triangle, 0]]
        start = origins if len(origins) == 1 else origins[hit]
        t = np.full(len(directions), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = dot(corner - start, normals) / dot(directions[hit], normals)
        t[hit] = np.where(distance > 0.0, distance, np.inf)
        return t

    def normals(self, points: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return [N, 3] outward unit normals at surface points that rays along ``directions`` [N, 3] hit first."""
        hit, triangle, _ = self.land(points, directions)
        normals = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
        normals[hit] = self.face_normals[triangle]  # Rounding lets few rays slip past an edge.
        return normals

    def land(self, points: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Find the triangles of surface points [N, 3] that rays along ``directions`` [N, 3] hit first.

        Returns indices of points [M], triangles [M] and the weights [M, 2] of these triangles' corners 1 and 2.
        """
        way = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        return self._cast(points - 1e-3 * way, way)


def rays(origins: np.ndarray, directions: np.ndarray) -> Any:
    """Return Open3D's rays of origins [N, 3] (or [1, 3]) and directions [N, 3]."""
    import open3d

    both = np.concatenate([np.broadcast_to(origins, directions.shape), directions], axis=1)
    return open3d.core.Tensor(both.astype(np.float32))


def raycaster(parts: list[Part]) -> Any:
    """Return Open3D's scene of these surfaces."""
    import open3d

    scene, tensor = open3d.t.geometry.RaycastingScene(), open3d.core.Tensor
    for vertices, triangles in parts:
        scene.add_triangles(tensor(vertices.astype(np.float32)), tensor(triangles.astype(np.uint32)))
    scene.cast_rays(tensor(np.zeros((1, 6), np.float32)))  # The first rays build its tree, which is not thread-safe.
    return scene
