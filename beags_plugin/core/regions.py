"""Simple regions of space: a block, a ball, the side of a plane."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass

from torch import Tensor


class Region(ABC):
    """A closed region of space. Its numbers are finite, in the frame and units of the points to be tested."""

    @abstractmethod
    def contains(self, points: Tensor) -> Tensor:
        """Return which of [N, 3] float points lie in it, [N] bool; points that are not finite do not."""


@dataclass(frozen=True)
class Block(Region):
    """A box along the axes. low, high: opposite corners (x, y, z); raises ``ValueError`` unless low < high."""

    low: tuple[float, ...]
    high: tuple[float, ...]

    def __post_init__(self) -> None:
        _check_finite((*self.low, *self.high))
        if len(self.low) != 3 or not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"the box {list(self.low)}, {list(self.high)} is not a lower and a higher [x, y, z]")

    def contains(self, points: Tensor) -> Tensor:
        return ((points >= points.new_tensor(self.low)) & (points <= points.new_tensor(self.high))).all(dim=1)


@dataclass(frozen=True)
class Ball(Region):
    """The points within ``radius`` of ``center`` (x, y, z); raises ``ValueError`` unless the radius is above 0."""

    center: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        _check_finite((*self.center, self.radius))
        if self.radius <= 0:
            raise ValueError(f"the radius {self.radius} of a sphere is not above 0")

    def contains(self, points: Tensor) -> Tensor:
        return ((points - points.new_tensor(self.center)) ** 2).sum(dim=1) <= self.radius**2


@dataclass(frozen=True)
class HalfSpace(Region):
    """The points x with normal . x >= offset; raises ``ValueError`` for a normal (x, y, z) of length 0."""

    normal: tuple[float, float, float]
    offset: float

    def __post_init__(self) -> None:
        _check_finite((*self.normal, self.offset))
        if not any(self.normal):
            raise ValueError("the normal of a plane is 0")

    def contains(self, points: Tensor) -> Tensor:
        return (points * points.new_tensor(self.normal)).sum(dim=1) >= self.offset


def _check_finite(values: Iterable[float]) -> None:
    if not all(map(math.isfinite, values := list(values))):
        raise ValueError(f"not all of {values} are finite numbers")
