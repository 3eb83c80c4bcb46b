"""Image-like surfaces with sharp detail at several scales: wood, brick, lettering, posters, book spines, weave.

A print maps coordinates u, v [N] (world units; v upward) to albedo [N, 3], linear RGB in 0..1. Random choices per cell
are values of ``Noise`` at whole numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from beags_plugin.sample.textures import Noise

Print = Callable[[np.ndarray, np.ndarray], np.ndarray]
Paint = Callable[[np.ndarray], np.ndarray]
"""Function of points [N, 3] in an object's frame; returns their albedo [N, 3]."""


def _at(noise: Noise, u: np.ndarray, v: np.ndarray, layer: float = 0.0) -> np.ndarray:
    return noise(np.stack([u, v, np.full_like(u, layer)], axis=1))


def _mix(first: np.ndarray, second: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return first + weight[:, None] * (second - first)


def plain(noise: Noise, colour: np.ndarray, contrast: float = 0.25) -> Print:
    """Return mottled plaster or clay, with fine grain."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        shade = 0.6 * _at(noise, 3.1 * u, 3.1 * v, 3.5) + 0.4 * _at(noise, 23.0 * u, 23.0 * v, 9.5)
        return colour * (1.0 - contrast * shade)[:, None]

    return paint


def wood(noise: Noise, light: np.ndarray, dark: np.ndarray, plank: float = 0.22) -> Print:
    """Return planks along u, ``plank`` wide, each with its own tone and grain, and dark joints."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        row = np.floor(v / plank)
        board = np.floor(u / (9.0 * plank) + 0.37 * row)
        tone = _at(noise, row, board, 5.0)
        wave = v + 0.05 * _at(noise, 1.5 * u, 5.0 * v, 7.3) + 3.0 * tone
        grain = 0.5 * _at(noise, 2.0 * u + 9.0 * tone, 55.0 * wave, 2.5) + 0.5 * np.sin(70.0 * wave) ** 2
        colour = _mix(light, dark, 0.65 * grain + 0.35 * tone)
        along = np.abs(u / (9.0 * plank) + 0.37 * row - board - 0.5) > 0.5 - 0.05
        joint = (np.abs(v / plank - row - 0.5) > 0.5 - 0.006 / plank) | (along & (np.abs(grain - 0.5) > 0.45))
        return colour * (1.0 - 0.65 * joint)[:, None]

    return paint


def bricks(noise: Noise, brick: np.ndarray, mortar: np.ndarray, high: float = 0.16) -> Print:
    """Return a brick wall in courses ``high`` high."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        row = np.floor(v / high)
        place = u / (2.6 * high) + 0.5 * (row % 2)
        tone = 0.55 + 0.6 * _at(noise, np.floor(place), row, 4.0)
        rough = 0.75 + 0.5 * _at(noise, 19.0 * u, 19.0 * v, 1.5)
        seam = (np.abs(v / high - row - 0.5) > 0.42) | (np.abs(place - np.floor(place) - 0.5) > 0.47)
        return np.where(seam[:, None], mortar * rough[:, None], brick * (tone * rough)[:, None])

    return paint


def _ink(noise: Noise, u: np.ndarray, v: np.ndarray, size: float) -> np.ndarray:
    """Return [N] bool, the ink of lines of made-up letters of 3 x 5 dots, ``size`` high."""
    line, column = np.floor(v / (1.7 * size)), np.floor(u / (0.8 * size))
    x, y = np.floor((u / (0.8 * size) - column) * 4.0), np.floor((v / (1.7 * size) - line) * 8.5)
    letter = _at(noise, column, line, 11.0)
    dot = _at(noise, x + np.floor(97.0 * letter), y, 13.0)
    return (letter > 0.22) & (x < 3.0) & (y < 5.0) & (dot > 0.42)


def lettering(noise: Noise, paper: np.ndarray, ink: np.ndarray, size: float) -> Print:
    """Return a page of lines, with a heading three times as large every 14 lines."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        block = 24.0 * size
        heading = v / block - np.floor(v / block) > 0.78
        inked = np.where(heading, _ink(noise, u, v, 3.0 * size), _ink(noise, u, v, size))
        return _mix(paper * (0.9 + 0.1 * _at(noise, 9.0 * u, 9.0 * v, 6.5))[:, None], ink, inked.astype(float))

    return paint


def poster(noise: Noise, colours: np.ndarray, wide: float, high: float) -> Print:
    """Return a framed picture around (0, 0): sky, sun, ridges and a line of print; colours [4, 3]."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x, y = u / wide + 0.5, v / high + 0.5
        colour = _mix(colours[0], colours[1], np.clip(1.4 * y - 0.4, 0.0, 1.0))
        sun = np.hypot(u - 0.2 * wide, v - 0.24 * high) < 0.14 * min(wide, high)
        colour = np.where(sun[:, None], colours[2], colour)
        for layer in range(3):
            rise = 0.62 - 0.16 * layer + 0.3 * (_at(noise, (3.0 + 2.0 * layer) * x, 0.0 * x, 2.0 * layer + 0.5) - 0.5)
            tone = 0.45 + 0.25 * layer + 0.3 * _at(noise, 40.0 * u, 40.0 * v, layer + 20.5)
            colour = np.where((y < rise)[:, None], colours[3 - layer % 2] * tone[:, None], colour)
        strip = y < 0.16
        inked = strip & _ink(noise, u, v + 0.46 * high, 0.07 * high)
        colour = np.where(strip[:, None], 0.85 - 0.8 * inked[:, None], colour)
        rim = np.minimum(0.5 * wide - np.abs(u), 0.5 * high - np.abs(v)) < 0.03
        return np.where(rim[:, None], 0.12 * colours[2] + 0.02, colour)

    return paint


def spines(noise: Noise, colours: np.ndarray) -> Print:
    """Return shelves of books: upright spines of random width, height and colour, with titles; colours [K, 3]."""
    shelf = 0.52

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        row = np.floor(v / shelf)
        up = v - row * shelf
        warped = u + 0.04 * np.sin(9.0 * u + 2.0 * row)  # Warping makes the widths of books differ.
        book = np.floor(warped / 0.11)
        across = warped / 0.11 - book - 0.5
        kind = _at(noise, book, row, 8.0)
        tall = 0.05 + (0.62 + 0.26 * _at(noise, book, row, 14.0)) * shelf
        colour = colours[np.floor(kind * 50.0).astype(np.int64) % len(colours)] * (1.0 - 1.2 * across**2)[:, None]
        band = np.abs(up - 0.25 * tall - 0.1) < 0.02
        title = (np.abs(across) < 0.25) & _ink(noise, up + 3.0 * kind, across * 0.11 + 5.0 * book, 0.045)
        colour = np.where((band | title)[:, None], 0.75 - 0.5 * colour, colour)
        shade = np.where(up < tall, 1.0, 0.0)[:, None] * colour + np.where(up < tall, 0.0, 1.0)[:, None] * 0.03
        return np.where((up < 0.05)[:, None], np.array([0.28, 0.17, 0.09]), shade)

    return paint


def weave(noise: Noise, light: np.ndarray, dark: np.ndarray, size: float) -> Print:
    """Return a weave of strands ``size`` wide."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        i, j = np.floor(u / size), np.floor(v / size)
        over = (i + j) % 2 > 0.5
        x, y = u / size - i - 0.5, v / size - j - 0.5
        bulge = 1.0 - 2.2 * np.where(over, y, x) ** 2 - 1.0 * np.where(over, x, y) ** 2
        return _mix(dark, light, np.where(over, 1.0, 0.35) * (0.5 + _at(noise, i, j, 3.0))) * bulge[:, None]

    return paint


def carpet(noise: Noise, colours: np.ndarray, wide: float, high: float) -> Print:
    """Return a rug around (0, 0): borders, and diamonds of four colours [4, 3]."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        edge = np.minimum(0.5 * wide - np.abs(u), 0.5 * high - np.abs(v))
        a, b = np.floor((u + v) / 0.34), np.floor((u - v) / 0.34)
        inner = np.floor(3.0 * ((u + v) / 0.34 - a)) == 1.0
        kind = np.where(edge < 0.22, np.floor(edge / 0.055) % 2, (a + 2.0 * b + inner) % 4).astype(np.int64)
        return colours[kind] * (0.7 + 0.4 * _at(noise, 28.0 * u, 28.0 * v, 16.5))[:, None]

    return paint


def stripes(noise: Noise, colours: np.ndarray, width: float) -> Print:
    """Return wallpaper: stripes along v of colours [K, 3] with small sprigs on every other one."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        i = np.floor(u / width)
        j = np.floor(v / width + 0.5 * (i % 4 > 1.5))
        x, y = u / width - i - 0.5, v / width + 0.5 * (i % 4 > 1.5) - j - 0.5
        petals = np.hypot(x, y) < 0.22 + 0.12 * np.cos(5.0 * np.arctan2(y, x) + 6.3 * _at(noise, i, j, 1.0))
        colour = colours[i.astype(np.int64) % 2]
        colour = np.where((petals & (i % 2 > 0.5))[:, None], colours[-1], colour)
        return colour * (0.85 + 0.2 * _at(noise, 21.0 * u, 21.0 * v, 12.5))[:, None]

    return paint


def within(ground: Print, *panels: tuple[float, float, float, float, Print]) -> Print:
    """Return a print with panels (u, v of the middle, width, height, print) on it."""

    def paint(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        colour = ground(u, v)
        for x, y, wide, high, panel in panels:
            on = np.flatnonzero((np.abs(u - x) < 0.5 * wide) & (np.abs(v - y) < 0.5 * high))
            colour[on] = panel(u[on] - x, v[on] - y)
        return colour

    return paint


def around(paint: Print, radius: float) -> Paint:
    """Wrap a print around the z axis of a turned shape; the print continues over its bottom and lid."""
    return lambda p: paint(radius * np.arctan2(p[:, 1], p[:, 0]), p[:, 2] + 0.6 * np.hypot(p[:, 0], p[:, 1]))


def faces(half: Sequence[float] | np.ndarray, prints: Sequence[Print]) -> Paint:
    """Put a print on each face (-x, +x, -y, +y, -z, +z) of the box |x_i| <= half_i; v runs along z, or y."""

    def paint(p: np.ndarray) -> np.ndarray:
        axis = np.argmax(np.abs(p) / np.array(half), axis=1)
        side = 2 * axis + (p[np.arange(len(p)), axis] > 0.0)
        colour = np.empty_like(p)
        for face in np.unique(side):
            on = np.flatnonzero(side == face)
            u, v = ((1, 2), (0, 2), (0, 1))[face // 2]
            colour[on] = prints[face](p[on, u], p[on, v])
        return colour

    return paint
