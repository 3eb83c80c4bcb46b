"""Exact ray casting of the still life: first hits, and each object's own silhouette."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.arrangement import DOME_RADIUS, Still, Thing
from beags_plugin.sample.solids import dot, turned

GROUND, DOME = 0, -1
CHUNK = 1 << 15
"""Rays traced at a time, so that the temporaries stay in the processor's cache."""


@dataclass(frozen=True)
class Hits:
    """First hits of N rays: ``t`` [N] float64, ``surface`` [N] int32 (class id of an object, GROUND or DOME)."""

    t: np.ndarray
    surface: np.ndarray


def object_hits(thing: Thing, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Find the rays that hit the object, were it alone, and where.

    origin: [3] outside of all objects; directions: [N, 3]. Returns indices [M] and their t [M].
    """
    offset = origin - thing.position
    # Only rays that cross the bounding ball; 1e-9 allows for the rounding of the bound itself.
    along, squared = dot(directions, offset[None]), offset @ offset - thing.solid.bound**2 * (1.0 + 1e-9)
    near = np.flatnonzero((along < 0.0) & (along * along >= squared * dot(directions, directions)))
    t = thing.solid.first_hit(thing.to_local(origin[None]), turned(directions[near], thing.rotation))
    hit = np.isfinite(t)
    return near[hit], t[hit]


def _surround(origin: np.ndarray, directions: np.ndarray) -> Hits:
    """Return hits of the ground or, beyond its edge, of the dome; the origin must lie inside."""
    a = dot(directions, directions)
    half_b = dot(directions, origin[None])
    t = (-half_b + np.sqrt(half_b * half_b - a * (origin @ origin - DOME_RADIUS**2))) / a
    with np.errstate(divide="ignore"):
        ground = np.where(directions[:, 2] < 0.0, -origin[2] / directions[:, 2], np.inf)
    return Hits(np.minimum(t, ground), np.where(ground < t, GROUND, DOME).astype(np.int32))


def first_hits(
    still: Still, origin: np.ndarray, directions: np.ndarray, without: int | None = None
) -> tuple[Hits, list[np.ndarray]]:
    """Find first hits of rays from one point, and for each object the rays that would hit it alone.

    origin: [3], world, inside the dome and outside of all objects; directions: [N, 3], any length. without: class id of
    an object that lets all rays pass.
    """
    hits = _surround(origin, directions)
    t, surface = hits.t, hits.surface
    silhouettes = []
    for class_id, thing in enumerate(still.things, start=1):
        rays, distances = object_hits(thing, origin, directions)
        silhouettes.append(rays)
        first = (distances < t[rays]) & (class_id != without)
        t[rays[first]] = distances[first]
        surface[rays[first]] = class_id
    return hits, silhouettes


def seen_share(still: Still, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the fraction [N] of unit ``directions`` [K, 3] that no object blocks, from ``origins`` [N, 3] outside."""
    blocked = np.zeros((len(directions), len(origins)), dtype=bool)
    for thing in still.things:
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
