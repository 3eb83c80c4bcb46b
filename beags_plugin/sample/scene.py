"""Parts of a generated scene: objects, their contacts, and the background around them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from beags_plugin.sample.solids import turned


class Body(Protocol):
    """A closed shape in its own frame, within ``bound`` of the frame's origin; ``solids.Solid`` is one."""

    @property
    def bound(self) -> float: ...

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray: ...


Shape = TypeVar("Shape", bound=Body, covariant=True)


@dataclass(frozen=True)
class Thing(Generic[Shape]):
    """One object: world = rotation @ local + position.

    rotation: [3, 3]; position: [3], world units, z up. texture: from points [N, 3] in its frame to albedo [N, 3].
    """

    name: str
    solid: Shape
    rotation: np.ndarray
    position: np.ndarray
    texture: Callable[[np.ndarray], np.ndarray]

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Return world points [N, 3] in the object's frame."""
        return turned(points - self.position, self.rotation)


@dataclass(frozen=True)
class Contact:
    """A world point [3] on the surfaces of both objects; i is the object of class id i, 0 the table or ground."""

    first: int
    second: int
    point: np.ndarray


@dataclass(frozen=True)
class Scene(ABC):
    """Objects (object i has class id i + 1), and around them the background, class 0, which every ray meets."""

    things: tuple[Thing[Any], ...]
    contacts: tuple[Contact, ...]

    @property
    def class_names(self) -> dict[int, str]:
        """Return class id to name, the background included."""
        return {0: "background", **{i: thing.name for i, thing in enumerate(self.things, start=1)}}

    @abstractmethod
    def surround(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the background's t [N] and part [N] (int32, 0 or less) for rays from a point inside."""


class Lighting(Protocol):
    """The light of a scene; surfaces look the same from every view, except the background of a turntable."""

    def colours(
        self, points: np.ndarray, surface: np.ndarray, directions: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        """Return [N, 3] linear RGB (may exceed 1) of world points [N, 3] that rays along ``directions`` hit first.

        surface: [N], as in ``Hits.surface``. center: [3], the camera's position.
        """
        ...


@runtime_checkable
class DirectLighting(Protocol):
    """A light that casts the rays of a photo itself, with hits that it can look up directly."""

    def seen(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return ``Lighting.colours`` of the first hits of rays from ``origin`` [3] along ``directions`` [N, 3]."""
        ...
