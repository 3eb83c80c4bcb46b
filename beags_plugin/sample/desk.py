"""A desk in the room, with six of the room's things that touch, for photos from all around."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock

import numpy as np

from beags_plugin.sample.family import Family
from beags_plugin.sample.light_map import LightMap
from beags_plugin.sample.meshes import SEGMENTS, Mesh, block, rays
from beags_plugin.sample.room import SHELL, Room, Shell, add_group, furnished
from beags_plugin.sample.room_light import SHARES, RoomLight
from beags_plugin.sample.room_things import Stock, make_ball, make_crate, make_mug, make_vase, standing
from beags_plugin.sample.scene import Contact, Thing
from beags_plugin.sample.solids import turn_z, turned
from beags_plugin.sample.textures import Noise
from beags_plugin.sample.views import View, direction, held_out, look_at, make_view

ELEVATIONS = (0.24, 0.52, 0.84)
"""Elevations of the three rounds of cameras above the desk, radians."""
TARGET = np.array([0.0, 0.0, 0.16])
DISTANCE, LENS = 1.70, 1.22
"""Distance of cameras from the target, world units, so that no wall is in between; focal length over width."""
TABLE = -1  # part of the background, see ``Room``
SPACING_THINGS, SPACING_TABLE, SPACING_ROOM = 0.012, 0.03, 0.1
"""Distance of the points where light is measured, world units."""


def make_desk(seed: int) -> Room:
    """Make the desk of a seed, which decides sizes, positions, rotations, textures and colours.

    A book leans on a crate with a star on it; a mug, a vase and a ball touch the crate's other sides.
    """
    generator = np.random.default_rng([seed, 14])
    shell = Shell.of(seed)
    noise = Noise(generator)
    hue = float(generator.uniform())
    stock = Stock(generator, noise, hue, spread=0.5)
    stack, mug = make_crate(stock), make_mug(stock, stock.about(0.135), stock.about(0.24))
    generator.random(9)  # The room of benchmarks/ draws these for spoon and basket: skipping them keeps old scenes.
    ball, vase = make_ball(stock), make_vase(stock)
    generator.random(7)  # These are for its frame.
    crate = stack.things[0]
    x, y = crate.solid.vertices[:, :2].max(axis=0)
    turn = shell.turn @ turn_z(generator.uniform(0.0, 2.0 * np.pi))
    things: list[Thing[Mesh]] = []
    contacts: list[Contact] = []
    add_group(things, contacts, stack, turn, -turn @ (crate.position * [1.0, 1.0, 0.0]))
    # Each thing stands near an end of its side, so that photos show the other end; the mug's handle points along it.
    for thing, face, gap, steps, along in (
        (mug, 0.5 * np.pi, x, 0, generator.uniform(-0.08, -0.02)),
        (vase, 0.0, y, generator.integers(SEGMENTS), generator.uniform(-0.12, -0.07)),
        (ball, np.pi, y, generator.integers(SEGMENTS), generator.uniform(-0.12, -0.06)),
    ):
        spin, way = turn_z(2.0 * np.pi * steps / SEGMENTS), turn @ turn_z(face)  # y points away from the crate.
        corners = turned(thing.solid.vertices, spin.T)
        nearest = corners[np.argmin(corners[:, 1].round(9))]
        shift = np.array([along, gap - nearest[1], 0.0])
        alone = standing(thing)
        add_group(things, contacts, alone, way @ spin, way @ shift)
        contacts.append(Contact(len(things), 1, way @ (shift + nearest + alone.things[0].position)))
    return furnished(things, contacts, shell, generator, noise, hue)


class DeskLight(RoomLight):
    """The light of a room, measured once on a grid over all surfaces, so that many photos need no further rays."""

    def __init__(self, room: Room) -> None:
        super().__init__(room)
        self._maps: dict[int, LightMap] = {}
        self._lock = Lock()
        parts = [*range(1, len(room.things) + 1), *(-1 - i for i in range(len(room.fixtures))), SHELL]
        self._parts = {which: number for number, which in enumerate(parts)}  # the order of ``RoomLight`` in Open3D

    def colours(
        self, points: np.ndarray, surface: np.ndarray, directions: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        colours = np.empty_like(points)
        for which in np.unique(surface):
            on = np.flatnonzero(surface == which)
            if which == SHELL:
                shell = self.room.shell
                local, way = shell.to_local(points[on]), turned(directions[on], shell.turn)
            else:
                thing = self.room.part(which)
                local, way = thing.to_local(points[on]), turned(directions[on], thing.rotation)
            colours[on] = self._albedo(which, local) * self._map(which).read(local, way)
        return colours

    def seen(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        hits = self._blockers.cast_rays(rays(origin[None], directions))
        part, triangle = (hits[name].numpy().astype(np.int64) for name in ("geometry_ids", "primitive_ids"))
        weights, colours = hits["primitive_uvs"].numpy().astype(np.float64), np.zeros_like(directions)
        for which, number in self._parts.items():
            on = np.flatnonzero(part == number)  # A ray that slips through an edge of the shell stays black.
            if len(on):
                light = self._map(which)
                corners = light.mesh.vertices[light.mesh.triangles[triangle[on]]]
                first, second = weights[on, :1], weights[on, 1:]
                local = corners[:, 0] * (1.0 - first - second) + corners[:, 1] * first + corners[:, 2] * second
                colours[on] = self._albedo(which, local) * light.at(triangle[on], weights[on])
        return colours

    def _albedo(self, which: int, local: np.ndarray) -> np.ndarray:
        return self.paper(local) if which == SHELL else self.room.part(which).texture(local)

    def _map(self, which: int) -> LightMap:
        """Return the light of a part, as in ``Hits.surface``; the first call measures it."""
        with self._lock:
            if which not in self._maps:
                self._maps[which] = self._baked(which)
            return self._maps[which]

    def _baked(self, which: int) -> LightMap:
        if which == SHELL:
            shell = self.room.shell
            inwards = Mesh(block(shell.half[0], shell.half[1], -shell.half[2], shell.half[2]))
            inwards.face_normals *= -1.0
            return LightMap(inwards, SPACING_ROOM, self._measure(shell.turn, shell.turn @ shell.middle))
        thing = self.room.part(which)
        spacing = SPACING_THINGS if which > 0 else SPACING_TABLE if which == TABLE else SPACING_ROOM
        return LightMap(thing.solid, spacing, self._measure(thing.rotation, thing.position))

    def _measure(self, rotation: np.ndarray, position: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
        """Return a function that measures light in the frame of a thing, with all samples of lamp and surroundings."""

        def measure(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
            places, ways = turned(points, rotation.T) + position, turned(normals, rotation.T)
            return np.mean(
                [self.light_at(places, ways, np.full(len(places), share)) for share in range(SHARES)], axis=0
            )

        return measure


def desk_views(seed: int, width: int, height: int, num_train: int, num_test: int) -> list[View]:
    """Make three jittered rounds around the desk at rising height, with test views spread evenly."""
    generator = np.random.default_rng([seed, 2])
    total, tests = num_train + num_test, held_out(num_train, num_test)
    start = generator.uniform(0.0, 2.0 * np.pi)
    views = []
    for i in range(total):
        progress = i * len(ELEVATIONS) / total
        level = int(progress)
        spread = generator.uniform(-1.0, 1.0, 7)
        azimuth = start + 2.0 * np.pi * (progress + level / 8.0) + 0.05 * spread[0]
        elevation = ELEVATIONS[level] + 0.04 * spread[1]
        target = TARGET + 0.05 * spread[2:5]
        place = target + DISTANCE * (1.0 + 0.04 * spread[5]) * direction(azimuth, elevation)
        pose = look_at(place, target, 0.04 * spread[6])
        views.append(make_view(i, i in tests, pose, LENS, width, height))
    return views


DESK = Family(make_desk, DeskLight, desk_views)
