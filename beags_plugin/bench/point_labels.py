"""Labels of the points of a diagram, placed so that none covers another, a point or a line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SIZE = "small"
_MARKER = 4.0  # pixels, half of a point's side
_GAP = 1.5  # pixels between two labels
_RINGS = (10, 14, 19, 25, 32, 40, 50, 62, 76, 92, 110, 130)  # pixels from a point, tried in turn
_NEAR = 18.0  # pixels; a label further away has a line to its point
_DIRECTIONS = sorted((math.radians(15 * turn) for turn in range(-11, 13)), key=abs)  # to the right first

Box = tuple[float, float, float, float]
"""(left, bottom, right, top) in pixels."""
Point = tuple[float, float, str, str]
"""(x, y) in the diagram's units, text and colour of its label."""


@dataclass
class _Taken:
    """What a label should not cover: other labels least of all."""

    labels: list[Box]
    points: list[Box]
    lines: list[Box]

    def cost(self, box: Box, leader: Sequence[Box]) -> int:
        """Return how bad a label is at ``box``, with boxes along the line to its point; 0 if it covers nothing."""
        hidden = any(_overlap(part, label) for part in leader for label in self.labels)
        covered = (sum(_overlap(box, other) for other in each) for each in (self.labels, self.points, self.lines))
        return sum(weight * count for weight, count in zip((100, 10, 3), covered, strict=True)) + 10 * hidden


def label_points(axes: Axes, points: Sequence[Point], path: Sequence[tuple[float, float]] = ()) -> list[Box]:
    """Write a label beside each point, beginning with those that come first; return the boxes of the labels.

    path: corners of a line, (x, y) each, that labels avoid too. To be called when the diagram's limits and place are
    final: a label keeps its distance from its point. Points outside of the diagram have none.
    """
    figure, to_pixels, to_units = axes.figure, axes.transData, axes.transData.inverted()
    renderer = figure.canvas.get_renderer()  # pyright: ignore[reportAttributeAccessIssue]
    frame = axes.get_window_extent()
    places = [to_pixels.transform(point[:2]).tolist() for point in points]
    corners = [to_pixels.transform(corner).tolist() for corner in path]
    sides = [(*map(min, a, b), *map(max, a, b)) for a, b in zip(corners, corners[1:], strict=False)]
    taken = _Taken([], [_around(x, y, _MARKER, _MARKER) for x, y in places], sides)
    for (x, y), (at_x, at_y, text, color) in zip(places, points, strict=True):
        if not (frame.x0 <= x <= frame.x1 and frame.y0 <= y <= frame.y1):
            continue
        note = axes.annotate(
            text, (at_x, at_y), (0, 0), textcoords="offset points", ha="center", va="center", fontsize=_SIZE,
            color=color,
        )  # fmt: skip
        size = note.get_window_extent(renderer)
        dx, dy, box, leader = _place(x, y, size.width / 2 + _GAP, size.height / 2 + _GAP, frame.extents, taken)
        note.set_position((72 * dx / figure.dpi, 72 * dy / figure.dpi))
        if leader:
            ends = to_units.transform([part[:2] for part in (leader[0], leader[-1])]).T
            axes.plot(*ends, color=color, lw=0.5, zorder=1, scalex=False, scaley=False)
        taken.labels.append(box)
        taken.lines += leader
    return taken.labels


def _place(
    x: float, y: float, half_width: float, half_height: float, frame: Sequence[float], taken: _Taken
) -> tuple[float, float, Box, list[Box]]:
    """Return the nearest good place of a label: its middle from the point (x, y), its box, and boxes along its line."""
    best = None
    for ring, direction in product(_RINGS, _DIRECTIONS):
        dx, dy = (ring + half_width - 6.0) * math.cos(direction), ring * math.sin(direction)
        box = _around(x + dx, y + dy, half_width, half_height)
        if box[0] < frame[0] or box[1] < frame[1] or box[2] > frame[2] or box[3] > frame[3]:
            continue
        leader = _leader(x, y, dx, dy, box)
        cost = taken.cost(box, leader)
        if best is None or cost < best[0]:
            best = cost, (dx, dy, box, leader)
        if cost == 0:
            break
    return best[1] if best else (0.0, 0.0, _around(x, y, half_width, half_height), [])


def _leader(x: float, y: float, dx: float, dy: float, box: Box) -> list[Box]:
    """Return small boxes along the line from a point to the label that fills ``box``; none for a near one."""
    length = math.hypot(dx, dy)
    if length <= _NEAR:
        return []
    count = int(length // 2)
    parts = [_around(x + dx * part / count, y + dy * part / count, 0.5, 0.5) for part in range(1, count)]
    return [part for part in parts if not _overlap(part, box)]


def _around(x: float, y: float, half_width: float, half_height: float) -> Box:
    return x - half_width, y - half_height, x + half_width, y + half_height


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
