"""Solid textures of medium frequency: lattice noise and patterns made from it.

A pattern maps points [N, 3] (in an object's own frame, world units) to a blend weight [N] in 0..1; a texture blends
its colours (linear RGB) by it and mottles the result. No detail is finer than about 0.05 units, so that small images
do not alias.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.solids import dot

LATTICE = 32
Pattern = Callable[[np.ndarray], np.ndarray]


class Noise:
    """Smooth value noise in 0..1 that repeats every 32 lattice cells; the seed decides the lattice."""

    def __init__(self, generator: np.random.Generator) -> None:
        self._values = generator.random(LATTICE**3).astype(np.float32)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return [N] in 0..1; points [N, 3] in lattice cells."""
        floor = np.floor(points)
        f = (points - floor).astype(np.float32)
        f = f * f * (3.0 - 2.0 * f)
        low = floor.astype(np.int32) & (LATTICE - 1)
        high = (low + 1) & (LATTICE - 1)
        x0, x1 = low[:, 0] * LATTICE**2, high[:, 0] * LATTICE**2
        y0, y1 = low[:, 1] * LATTICE, high[:, 1] * LATTICE
        z0, z1 = low[:, 2], high[:, 2]
        fx, fy, fz = f[:, 0], f[:, 1], f[:, 2]

        def along_z(base: np.ndarray) -> np.ndarray:
            first = self._values[base + z0]
            return first + fz * (self._values[base + z1] - first)

        a, b = along_z(x0 + y0), along_z(x0 + y1)
        c, d = along_z(x1 + y0), along_z(x1 + y1)
        front, back = a + fy * (b - a), c + fy * (d - c)
        return front + fx * (back - front)


def _edge(value: np.ndarray, sharpness: float) -> np.ndarray:
    """Return a smooth step from 0 to 1 about value = 0."""
    return 0.5 + 0.5 * np.tanh(sharpness * value)


def checks(cells: float) -> Pattern:
    """Return a three-dimensional checkerboard with ``cells`` per unit."""
    return lambda p: _edge(np.prod(np.sin(np.pi * (cells * p + 0.25)), axis=1), 12.0)


def bands(per_unit: float, twist: float = 0.0) -> Pattern:
    """Return ``per_unit`` pairs of bands along z; ``twist`` turns (a whole number) make them a helix."""
    return lambda p: _edge(
        np.sin(2.0 * np.pi * per_unit * p[:, 2] + twist * np.arctan2(p[:, 1], p[:, 0])),
        3.0,
    )


def sectors(count: int, slant: float = 0.0) -> Pattern:
    """Return ``count`` pairs of stripes about the z axis, leaning by ``slant`` radians per unit of z."""
    return lambda p: _edge(np.sin(count * np.arctan2(p[:, 1], p[:, 0]) + slant * p[:, 2]), 3.0)


def blotches(noise: Noise, cells: float) -> Pattern:
    """Return irregular spots, ``cells`` lattice cells per unit."""
    return lambda p: _edge(noise(cells * p) - 0.5, 9.0)


def marble(noise: Noise, per_unit: float) -> Pattern:
    """Return wavy veins, ``per_unit`` pairs along a slanting axis."""
    axis = np.array([[0.6, 0.35, 0.72]])

    def pattern(p: np.ndarray) -> np.ndarray:
        return _edge(np.sin(2.0 * np.pi * (per_unit * dot(p, axis) + 1.6 * noise(6.0 * p))), 1.6)

    return pattern


@dataclass(frozen=True)
class Texture:
    """Two colours blended by a pattern, and spots of a third.

    light, dark, fleck: [3] linear RGB. The mottle changes brightness by up to ``contrast`` and adds the fleck colour.
    """

    pattern: Pattern
    light: np.ndarray
    dark: np.ndarray
    fleck: np.ndarray
    noise: Noise
    cells: float = 11.0
    contrast: float = 0.35

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return [N, 3] albedo, linear RGB in 0..1; points [N, 3] in the object's frame."""
        weight = self.pattern(points)[:, None]
        colour = self.dark + weight * (self.light - self.dark)
        mottle = self.noise(self.cells * points + 7.3)
        spots = _edge(self.noise(0.8 * self.cells * points + 17.9) - 0.68, 16.0)[:, None]
        colour = colour + (0.75 * spots) * (self.fleck - colour)
        return colour * (1.0 - self.contrast * mottle)[:, None]


def linear_from_hsv(hue: float, saturation: float, value: float) -> np.ndarray:
    """Return [3] linear RGB of a display colour given as hue (in turns), saturation and value."""
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, saturation, value)) ** 2.2
