"""Mask errors of any degree, and those that most views share: a plinth is included, or a foot is left out.

Each flaw that views share is a region of space, so that they agree on it. Seed and names decide everything.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]  (compiled, without stubs)

from beags_plugin.sample.degrade import PRESETS, Degradation, lowest_lots, resolve_degradation
from beags_plugin.sample.scene import Scene, Thing
from beags_plugin.sample.solids import dot, turned
from beags_plugin.sample.views import View, pixel_directions
from beags_plugin.system.errors import UserError

CHORDS = 4096  # rays that sample the surface of an object
FOOT = 0.15  # height of an object's foot over the object's height
TAKEN_IN = 0.25, 0.40
"""Range of the included region's reach beyond the foot, over half of the object's width or height, if larger."""
LEFT_OUT = 0.06, 0.14
"""Range of the share of an object's surface that is left out."""


def degradation_of_degree(degree: float) -> Degradation:
    """Interpolate the presets linearly: degree 0 is "none", 1 "mild", 2 "strong"; above 2, extrapolate.

    Raises ``UserError`` for a degree below 0, or so high that a share would exceed 1.
    """
    if not 0.0 <= degree < math.inf:
        raise UserError(f"the degree of mask degradation is {degree}: give a number from 0 on (1 is mild, 2 strong).")
    steps = [PRESETS[name] for name in ("none", "mild", "strong")]
    first = min(int(degree), len(steps) - 2)
    low, high, share = steps[first], steps[first + 1], degree - first
    values = (
        (1.0 - share) * getattr(low, name) + share * getattr(high, name) for name in ("rim", "dropped", "swapped")
    )
    return resolve_degradation(Degradation(*values))


@dataclass(frozen=True)
class Near:
    """The region within ``radius`` of some of ``points`` [F, 3], world."""

    points: np.ndarray
    radius: float

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return [P] bool: which world points [P, 3] lie in the region."""
        return np.isfinite(cKDTree(self.points).query(points, distance_upper_bound=self.radius)[0])


@dataclass(frozen=True)
class Beyond:
    """The half-space of points that lie farther along ``way`` [3] than ``limit``."""

    way: np.ndarray
    limit: float

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return [P] bool: which world points [P, 3] lie in the region."""
        return dot(points, self.way[None]) > self.limit


@dataclass(frozen=True)
class Flaw:
    """An error in the masks of ``views``: surface of the classes ``wrong`` in the region has the id ``instead``."""

    wrong: frozenset[int]
    instead: int
    region: Near | Beyond
    views: set[str]


def plan_flaws(scene: Scene, train: Sequence[str], seed: int, share: float) -> list[Flaw]:
    """Return a flaw of half of the objects, each in the masks of a ``share`` of the training views.

    The masks of every second object, from the first on, include the surface below it around its foot; those of the
    others lack the lowest part on one side. Each flaw has views of its own.
    """
    count = round(share * len(train))
    if not count:
        return []
    generator = np.random.default_rng([seed, 14])
    order = 1 + generator.permutation(len(scene.things))
    flaws = []
    for i, class_id in enumerate(order[: (len(order) + 1) // 2].tolist()):
        surface = _surface(scene.things[class_id - 1])
        angle = generator.uniform(0.0, 2.0 * np.pi)
        views = lowest_lots(train, seed, count, 14 + class_id)
        if i % 2 == 0:
            below = {contact.second for contact in scene.contacts if contact.first == class_id}
            extent = np.ptp(surface, axis=0)
            foot = surface[surface[:, 2] <= surface[:, 2].min() + FOOT * extent[2]]
            near = Near(foot, float(0.5 * generator.uniform(*TAKEN_IN) * extent.max()))
            flaws.append(Flaw(frozenset(below | {0}), class_id, near, views))
        else:
            way = np.array([np.cos(angle), np.sin(angle), -1.0]) / np.sqrt(2.0)
            limit = np.quantile(dot(surface, way[None]), 1.0 - generator.uniform(*LEFT_OUT))
            flaws.append(Flaw(frozenset({class_id}), 0, Beyond(way, float(limit)), views))
    return flaws


def flawed_mask(labels: np.ndarray, depth: np.ndarray, view: View, flaws: Sequence[Flaw]) -> np.ndarray:
    """Return ``labels`` [H, W] with the view's flaws; depth: [H, W], exact, along the optical axis."""
    out = labels.copy()
    for flaw in flaws:
        if view.name in flaw.views:
            pixels = np.flatnonzero(np.isin(labels, list(flaw.wrong)))
            places = view.center + depth.reshape(-1, 1)[pixels] * pixel_directions(view)[pixels]
            out.ravel()[pixels[flaw.region.holds(places)]] = flaw.instead
    return out


def _surface(thing: Thing[Any]) -> np.ndarray:
    """Return world points [P, 3] of an object's surface, where rays from above and from the sides meet it."""
    generator = np.random.default_rng(0)
    start, end = generator.normal(size=(2, CHORDS, 3))
    start, end = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (start, end))
    start[:, 2] = np.abs(start[:, 2])
    # Rays begin on the upper half of a sphere around the object, and pass through its bounding ball.
    start, end = 2.0 * start, end * generator.uniform(size=(CHORDS, 1)) ** (1.0 / 3.0)
    origins, directions = (turned(thing.solid.bound * vectors, thing.rotation) for vectors in (start, end - start))
    t = thing.solid.first_hit(origins, directions)
    hit = np.isfinite(t)
    return turned(origins[hit] + t[hit, None] * directions[hit], thing.rotation.T) + thing.position
