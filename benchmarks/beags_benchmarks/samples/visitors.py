"""A visitor: a thing of the background that stands in some photos of a capture, in another place in each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from beags_plugin.sample.arrangement import Still
from beags_plugin.sample.degrade import view_generator
from beags_plugin.sample.meshes import Mesh, lathe
from beags_plugin.sample.prints import Paint, around, stripes
from beags_plugin.sample.room import Room
from beags_plugin.sample.scene import Scene, Thing
from beags_plugin.sample.solids import Ball, Cone, Solid, slab
from beags_plugin.sample.textures import Noise, linear_from_hsv
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import View

AROUND_STILL, AROUND_ROOM = (1.08, 1.28), (1.60, 1.66)
"""Ranges of the visitor's distance from the z axis, world units: beyond all objects, with its shadow in the light's
map; beyond the table, before the cameras and the wall."""
SHARES = (0.04, 0.14)
"""Range of the share of a photo that its visitor should cover."""
PLACES = 24  # positions that are tried for each photo
RAYS = 32, 24  # rays across and down that measure the share, for photos of every size


def with_visitor(scene: Scene, view: View, seed: int) -> Scene:
    """Return the scene with the visitor where ``view`` shows it; the seed and the view's name decide.

    The visitor is the last fixture: it is background in every mask, and casts shadows.
    """
    generator = view_generator(seed, view.name, 9)
    wanted = generator.uniform(*SHARES)
    low, high = AROUND_ROOM if isinstance(scene, Room) else AROUND_STILL
    angle, distance = generator.uniform(0.0, 2.0 * np.pi, PLACES), generator.uniform(low, high, PLACES)
    visitor = _visitor(scene, seed)
    x, y = ((np.arange(n) + 0.5) / n * size for n, size in zip(RAYS, (view.width, view.height), strict=True))
    directions = view.directions(*(grid.ravel() for grid in np.meshgrid(x, y)))
    empty = first_hits(scene, view.center, directions)[0].t
    best, least = scene, np.inf
    for place in np.stack([distance * np.cos(angle), distance * np.sin(angle), np.zeros(PLACES)], axis=1):
        moved = tuple(replace(part, position=part.position + place) for part in visitor)
        visited: Scene = replace(scene, fixtures=(*scene.fixtures, *moved))  # type: ignore[attr-defined]
        share = np.mean(first_hits(visited, view.center, directions)[0].t < empty)
        if abs(share - wanted) < least:
            best, least = visited, abs(share - wanted)
    return best


def _visitor(scene: Scene, seed: int) -> tuple[Thing[Any], ...]:
    """Return the parts of the visitor, a body and a head, above the world's origin; the seed decides its colours."""
    generator = np.random.default_rng([seed, 10])
    noise, hue = Noise(generator), generator.uniform()
    shirt = [linear_from_hsv(hue, 0.75, 0.85), linear_from_hsv(hue + 0.4, 0.5, 0.35)]
    paint = around(stripes(noise, np.stack([*shirt, shirt[0]]), 0.05), 0.12)
    if isinstance(scene, Room):
        return (_figure(float(scene.shell.middle[2] - scene.shell.half[2]), paint),)
    assert isinstance(scene, Still)
    body = Solid((Cone(0.17, 0.80), *slab(2, 0.0, 0.36)), bound=0.40)
    head = Solid((Ball(0.10),), bound=0.10)
    upright = np.eye(3)
    return (
        Thing("body", body, upright, np.zeros(3), paint),
        Thing("head", head, upright, np.array([0.0, 0.0, 0.44]), paint),
    )


def _figure(floor: float, paint: Paint) -> Thing[Mesh]:
    """Return a figure that stands on the floor and rises above the table, z = 0, by half a unit."""
    body = lathe(np.array([(0.0, floor), (0.20, floor), (0.17, 0.12), (0.13, 0.22), (0.05, 0.26), (0.0, 0.26)]))
    polar = np.linspace(0.0, np.pi, 25)
    ball = np.stack([0.10 * np.sin(polar), 0.36 - 0.10 * np.cos(polar)], axis=1)
    ball[[0, -1], 0] = 0.0
    return Thing("figure", Mesh(body, lathe(ball)), np.eye(3), np.zeros(3), paint)
