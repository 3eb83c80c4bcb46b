"""Solids for exact ray casting: an intersection of convex primitives minus another one.

A ray meets a convex body in one interval, so the first hit of ``add \\ cut`` needs no iteration. Everything is in the
solid's own frame; lengths are world units, rays are ``origin + t direction`` with directions of any length (t scales
with it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

Interval = tuple[np.ndarray, np.ndarray]
"""(t_in [N], t_out [N]); empty where t_in >= t_out."""


class Primitive(Protocol):
    """A convex body."""

    def interval(self, origins: np.ndarray, directions: np.ndarray) -> Interval:
        """Return the part of each ray inside; origins and directions [N, 3], either of which may be [1, 3]."""
        ...

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return [N] signed distance to the (infinite) surface, negative inside; points [N, 3]."""
        ...

    def normal(self, points: np.ndarray) -> np.ndarray:
        """Return [N, 3] outward unit normals of the surface at points on it."""
        ...


def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return [N] row-wise products of [N, k] and [N, k], either of which may be [1, k].

    Determinism: the last bit of a BLAS product may depend on the number of threads.
    """
    total = a[:, 0] * b[:, 0]
    for i in range(1, a.shape[1]):
        total = total + a[:, i] * b[:, i]
    return total


def turned(points: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return [N, 3] ``points @ matrix``, without BLAS as in ``dot``."""
    return np.stack([dot(points, matrix[None, :, j]) for j in range(matrix.shape[1])], axis=1)


def turn_z(angle: float) -> np.ndarray:
    """Return the rotation [3, 3] about z by an angle in radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _quadratic(a: np.ndarray, half_b: np.ndarray, c: np.ndarray) -> Interval:
    """Return where a t^2 + 2 half_b t + c <= 0 for a > 0; for a = 0 (a ray along a tube) everywhere or nowhere."""
    discriminant = half_b * half_b - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(np.maximum(discriminant, 0.0))
        near, far = (-half_b - root) / a, (-half_b + root) / a
    flat = a == 0.0
    near = np.where(flat, np.where(c <= 0.0, -np.inf, np.inf), near)
    far = np.where(flat, np.where(c <= 0.0, np.inf, -np.inf), far)
    miss = ~flat & (discriminant <= 0.0)
    return np.where(miss, np.inf, near), np.where(miss, -np.inf, far)


@dataclass(frozen=True)
class HalfSpace:
    """The points with ``sign * x[axis] <= limit``."""

    axis: int
    sign: float
    limit: float

    def interval(self, origins: np.ndarray, directions: np.ndarray) -> Interval:
        speed = self.sign * directions[:, self.axis]
        room = self.limit - self.sign * origins[:, self.axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = room / speed
        still = (speed == 0.0) & (room < 0.0)
        near = np.where(speed < 0.0, t, np.where(still, np.inf, -np.inf))
        far = np.where(speed > 0.0, t, np.where(still, -np.inf, np.inf))
        return near, far

    def distance(self, points: np.ndarray) -> np.ndarray:
        return self.sign * points[:, self.axis] - self.limit

    def normal(self, points: np.ndarray) -> np.ndarray:
        normals = np.zeros_like(points)
        normals[:, self.axis] = self.sign
        return normals


@dataclass(frozen=True)
class Ball:
    """A ball about the frame's origin."""

    radius: float

    def interval(self, origins: np.ndarray, directions: np.ndarray) -> Interval:
        c = dot(origins, origins) - self.radius**2
        return _quadratic(dot(directions, directions), dot(origins, directions), c)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points, axis=1) - self.radius

    def normal(self, points: np.ndarray) -> np.ndarray:
        return points / np.linalg.norm(points, axis=1, keepdims=True)


@dataclass(frozen=True)
class Tube:
    """An infinite cylinder about the z axis."""

    radius: float

    def interval(self, origins: np.ndarray, directions: np.ndarray) -> Interval:
        o, d = origins[:, :2], directions[:, :2]
        c = dot(o, o) - self.radius**2
        return _quadratic(dot(d, d), dot(o, d), c)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return np.hypot(points[:, 0], points[:, 1]) - self.radius

    def normal(self, points: np.ndarray) -> np.ndarray:
        normals = np.concatenate([points[:, :2], np.zeros_like(points[:, :1])], axis=1)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@dataclass(frozen=True)
class Cone:
    """An infinite cone below its apex at (0, 0, height); its radius at z = 0 is ``radius``."""

    radius: float
    height: float

    def interval(self, origins: np.ndarray, directions: np.ndarray) -> Interval:
        slope = self.radius / self.height
        # x^2 + y^2 - slope^2 (z - height)^2 <= 0 is a double cone: the nappe below the apex is chosen at the end.
        stretch = np.array([1.0, 1.0, -(slope**2)])
        o = origins - np.array([0.0, 0.0, self.height])
        a = dot(directions**2, stretch[None])
        half_b = dot(o * stretch, directions)
        c = dot(o**2, stretch[None])
        root = np.sqrt(np.maximum(half_b * half_b - a * c, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (-half_b - root) / a, (-half_b + root) / a
        near, far = np.minimum(one, two), np.maximum(one, two)
        miss = (half_b * half_b - a * c <= 0.0) | (a == 0.0)
        # A ray steeper than the cone (a < 0) is inside where t is not between the roots: below the apex, on one half
        # line.
        steep, down = a < 0.0, directions[:, 2] < 0.0
        start = np.where(steep, np.where(down, far, -np.inf), near)
        stop = np.where(steep, np.where(down, np.inf, near), far)
        # A shallow ray has both roots on one nappe.
        above = ~steep & (o[:, 2] + 0.5 * (start + stop) * directions[:, 2] > 0.0)
        miss |= above
        return np.where(miss, np.inf, start), np.where(miss, -np.inf, stop)

    def distance(self, points: np.ndarray) -> np.ndarray:
        across = np.hypot(points[:, 0], points[:, 1])
        return (self.height * across + self.radius * (points[:, 2] - self.height)) / np.hypot(self.radius, self.height)

    def normal(self, points: np.ndarray) -> np.ndarray:
        # At the apex, the only surface point on the axis, any horizontal direction will do; 1e-12 avoids 0 / 0.
        across = np.maximum(np.hypot(points[:, 0], points[:, 1]), 1e-12)
        up = np.full_like(across, self.radius)
        normals = np.stack([self.height * points[:, 0] / across, self.height * points[:, 1] / across, up], axis=1)
        return normals / np.hypot(self.radius, self.height)


def slab(axis: int, low: float, high: float) -> tuple[HalfSpace, HalfSpace]:
    """Return the two half-spaces of low <= x[axis] <= high."""
    return HalfSpace(axis, -1.0, -low), HalfSpace(axis, 1.0, high)


def _meet(primitives: tuple[Primitive, ...], origins: np.ndarray, directions: np.ndarray) -> Interval:
    near, far = primitives[0].interval(origins, directions)
    for primitive in primitives[1:]:
        a, b = primitive.interval(origins, directions)
        near, far = np.maximum(near, a), np.minimum(far, b)
    return near, far


@dataclass(frozen=True)
class Solid:
    """The intersection of ``add`` minus the intersection of ``cut`` (nothing if empty).

    bound: radius of a ball about the frame's origin that contains the solid.
    """

    add: tuple[Primitive, ...]
    cut: tuple[Primitive, ...] = ()
    bound: float = 1.0

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return [N] smallest t > 0 at which rays from outside enter the solid, infinity if none."""
        near, far = _meet(self.add, origins, directions)
        near = np.where((near < far) & (near > 0.0), near, np.inf)
        if not self.cut:
            return near
        cut_near, cut_far = _meet(self.cut, origins, directions)
        # Where the ray enters ``add`` inside the cut, the hit is where it leaves the cut, if it is still in ``add``.
        hollow = (cut_near <= near) & (near < cut_far)
        return np.where(hollow, np.where(cut_far < far, cut_far, np.inf), near)

    def occludes(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return [N] bool, whether the solid lies at t > 0; origins may be anywhere outside it, also in the hollow."""
        near, far = _meet(self.add, origins, directions)
        near = np.maximum(near, 0.0)
        if not self.cut:
            return near < far
        cut_near, cut_far = _meet(self.cut, origins, directions)
        cut_empty = cut_near >= cut_far
        return (near < far) & (cut_empty | (near < cut_near) | (cut_far < far))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Return [N] a lower bound of the signed distance, whose sign and zeros are exact; points [N, 3]."""
        value = np.max([p.distance(points) for p in self.add], axis=0)
        if self.cut:
            value = np.maximum(value, -np.max([p.distance(points) for p in self.cut], axis=0))
        return value

    def normals(self, points: np.ndarray) -> np.ndarray:
        """Return [N, 3] outward unit normals at surface points [N, 3]: those of the primitive of nearest surface."""
        parts = [(p, 1.0) for p in self.add] + [(p, -1.0) for p in self.cut]
        nearest = np.argmin([np.abs(p.distance(points)) for p, _ in parts], axis=0)
        normals = np.zeros_like(points)
        for index, (primitive, sign) in enumerate(parts):
            chosen = nearest == index
            if chosen.any():
                normals[chosen] = sign * primitive.normal(points[chosen])
        return normals
