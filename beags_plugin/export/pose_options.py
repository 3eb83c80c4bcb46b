"""Options of the pose and size of exported objects, and the parsing of their texts."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from beags_plugin.system.errors import UserError

METRES = {"mm": 0.001, "cm": 0.01, "m": 1.0, "in": 0.0254, "ft": 0.3048}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_POINT = rf"(?:[^\s:][^:]*:{_NUMBER},{_NUMBER}|{_NUMBER},{_NUMBER},{_NUMBER})"
_LENGTH = rf"({_NUMBER})\s*({'|'.join(METRES)})"
_SCALE = re.compile(rf"\s*({_POINT})\s+({_POINT})\s+{_LENGTH}\s*")
_DIGITS = 4  # digits of two points' coordinates, counted from the first one of their distance


@dataclass(frozen=True)
class PhotoPoint:
    """A pixel of a photo: its view's name, and x to the right and y down from the centre of the first pixel."""

    view: str
    x: float
    y: float


Point = PhotoPoint | tuple[float, float, float]
"""A point that a photo shows, or coordinates in the input's world."""


@dataclass(frozen=True)
class KnownLength:
    """Two points that are ``metres`` apart."""

    first: Point
    second: Point
    metres: float


@dataclass(frozen=True)
class PoseOptions:
    """Options of the pose and size of exported objects."""

    up: str = ""
    """Turn objects so that z is up: plane, up is normal to the plane that each stands on; or x,y,z, the direction of
    the input's world that is up."""
    centre: bool = False
    """Put the origin at the foot of each object, under its middle."""
    scale_by: str = ""
    """Scale files to a known length: "A B 12 cm", two points and their distance in mm, cm, m, in or ft. A point is a
    photo's pixel, frame_0012:340,215, or x,y,z of the input's world."""

    def __post_init__(self) -> None:
        self.direction()
        self.length()

    def direction(self) -> tuple[float, float, float] | None:
        """Return the direction of ``up``; None for a plane or nothing. Raises ``UserError`` for another text."""
        if self.up in ("", "plane"):
            return None
        parts = self.up.split(",")
        numbers = [float(part) for part in parts if re.fullmatch(_NUMBER, part.strip())]
        if not (len(parts) == len(numbers) == 3 and 0 < math.hypot(*numbers) < math.inf):
            raise UserError(f"up is {self.up!r}: give plane, or a direction such as 0,0,1.")
        return numbers[0], numbers[1], numbers[2]

    def length(self) -> KnownLength | None:
        """Return the known length of ``scale_by``; None without one. Raises ``UserError`` for another text."""
        if not self.scale_by:
            return None
        match = _SCALE.fullmatch(self.scale_by)
        if match is None:
            raise UserError(
                f"scale_by is {self.scale_by!r}: give two points, a length and its unit, such as "
                '"frame_0012:340,215 frame_0012:512,220 12 cm".'
            )
        first, second, number, unit = match.groups()
        metres = float(number) * METRES[unit]
        if not 0 < metres < math.inf:
            raise UserError(f"scale_by is {self.scale_by!r}: the length must be above 0.")
        return KnownLength(_point(first), _point(second), metres)


def check_length(text: str) -> tuple[str, str]:
    """Return the number and unit of a text such as 12 cm; raises ``UserError`` for another text."""
    match = re.fullmatch(rf"\s*{_LENGTH}\s*", text)
    if match is None or not 0 < float(match[1]) * METRES[match[2]] < math.inf:
        *others, last = METRES
        raise UserError(f"{text.strip()!r} is no length: give one such as 12 cm, in {', '.join(others)} or {last}.")
    return match[1], match[2]


def scale_by_text(first: Sequence[float], second: Sequence[float], length: str) -> str:
    """Return the text of ``scale_by`` for two distinct points [3] of the input's world.

    length: such as 12 cm. Raises ``UserError`` for another text.
    """
    number, unit = check_length(length)
    digits = max(0, _DIGITS - math.floor(math.log10(math.dist(first, second))))
    a, b = (",".join(f"{round(x, digits) + 0.0:.{digits}f}" for x in point) for point in (first, second))
    return f"{a} {b} {number} {unit}"


def _point(text: str) -> Point:
    view, colon, numbers = text.rpartition(":")
    values = [float(number) for number in numbers.split(",")]
    return PhotoPoint(view, values[0], values[1]) if colon else (values[0], values[1], values[2])
