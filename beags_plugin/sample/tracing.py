"""Exact ray casting of a scene: first hits, and the silhouette of each object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.sample.scene import Scene, Thing
from beags_plugin.sample.solids import Solid, dot, turned

CHUNK = 1 << 15
"""Rays traced at a time, so that the temporaries stay in the processor's cache."""


@dataclass(frozen=True)
class Hits:
    """First hits of N rays: ``t`` [N] float64, ``surface`` [N] int32: class id, or a part of the background (<= 0)."""

    t: np.ndarray
    surface: np.ndarray


def object_hits(thing: Thing[Any], origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the rays that would hit the object if it were alone.

    origin: [3] outside of all objects; directions: [N, 3]. Returns indices [M] and their t [M].
    """
    offset = origin - thing.position
    # Only rays through the bounding ball are traced; 1e-9 covers the rounding of the bound itself.
    along, squared = dot(directions, offset[None]), offset @ offset - thing.solid.bound**2 * (1.0 + 1e-9)
    away = (along >= 0.0) & (squared > 0.0)
    near = np.flatnonzero(~away & (along * along >= squared * dot(directions, directions)))
    t = thing.solid.first_hit(thing.to_local(origin[None]), turned(directions[near], thing.rotation))
    hit = np.isfinite(t)
    return near[hit], t[hit]


def hit_fixtures(
    fixtures: Sequence[Thing[Any]],
    origin: np.ndarray,
    directions: np.ndarray,
    t: np.ndarray,
    part: np.ndarray,
    first_part: int,
) -> tuple[np.ndarray, np.ndarray]:
    """Add hits of the background's fixtures to its ``t`` and ``part`` [N]; fixture i is part ``first_part`` - i."""
    for i, fixture in enumerate(fixtures):
        rays, distances = object_hits(fixture, origin, directions)
        first = distances < t[rays]
        t[rays[first]] = distances[first]
        part[rays[first]] = first_part - i
    return t, part


def first_hits(scene: Scene, origin: np.ndarray, directions: np.ndarray) -> tuple[Hits, list[np.ndarray]]:
    """Find the first hits of rays from one point, and for each object the rays that would hit it if it were alone.

    origin: [3], world, inside the background and outside of all objects; directions: [N, 3], any length.
    """
    t, surface = scene.surround(origin, directions)
    silhouettes = []
    for class_id, thing in enumerate(scene.things, start=1):
        rays, distances = object_hits(thing, origin, directions)
        silhouettes.append(rays)
        first = distances < t[rays]
        t[rays[first]] = distances[first]
        surface[rays[first]] = class_id
    return Hits(t, surface), silhouettes


def seen_share(things: Sequence[Thing[Solid]], origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the share [N] of unit ``directions`` [K, 3] that no object blocks, from ``origins`` [N, 3] outside."""
    blocked = np.zeros((len(directions), len(origins)), dtype=bool)
    for thing in things:
        offset = origins - thing.position
        squared = dot(offset, offset) - thing.solid.bound**2 * (1.0 + 1e-9)
        local = thing.to_local(origins)
        for direction, dark in zip(directions, blocked, strict=True):
            along = dot(offset, direction[None])
            near = np.flatnonzero(((along < 0.0) & (along * along >= squared)) | (squared <= 0.0))
            near = near[~dark[near]]
            if len(near):
                dark[near] = thing.solid.occludes(local[near], (direction @ thing.rotation)[None])
    return 1.0 - blocked.sum(axis=0) / len(directions)
