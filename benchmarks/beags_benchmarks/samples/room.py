"""The room: objects that lean on, stand on and lie in one another, on the whole table of a furnished room.

Cameras pass on one side of the table, so that photos show parts of the room well, hardly, or not at all.
"""

from __future__ import annotations

import numpy as np

from beags_plugin.sample import prints
from beags_plugin.sample.family import Family
from beags_plugin.sample.meshes import Mesh, extrude, lathe, sweep
from beags_plugin.sample.room import SHELL, Room, Shell, add_group, furnished
from beags_plugin.sample.room_light import SHARES, RoomLight
from beags_plugin.sample.room_things import (
    MUG_FLOOR,
    MUG_WALL,
    Group,
    Stock,
    make_ball,
    make_crate,
    make_mug,
    make_vase,
    standing,
    superellipse,
)
from beags_plugin.sample.scene import Contact, Thing
from beags_plugin.sample.solids import turn_z, turned
from beags_plugin.sample.textures import Noise
from beags_plugin.sample.views import View, direction, held_out, look_at, make_view

SLOTS = ((-0.66, 0.34), (0.66, 0.36), (0.0, 0.0), (-0.58, -0.40), (0.58, -0.38))
"""Positions of the groups on the table; its middle is the world's origin."""
ARC = 1.85
"""Radians to either side of the table's front within which photos are taken."""
ELEVATIONS = (0.24, 0.50, 0.80)
TARGET = np.array([0.0, 0.0, 0.14])


def make_room(seed: int) -> Room:
    """Make the room of a seed, which decides sizes, positions, rotations, textures and colours."""
    generator = np.random.default_rng([seed, 12])
    shell = Shell.of(seed)
    noise = Noise(generator)
    hue = float(generator.uniform())
    stock = Stock(generator, noise, hue)
    groups = [make(stock) for make in (make_crate, _mug, _basket, lambda stock: standing(make_vase(stock)), _frame)]
    things: list[Thing[Mesh]] = []
    contacts: list[Contact] = []
    for group, slot in zip(groups, generator.permutation(np.array(SLOTS)), strict=True):
        place = np.array([*(slot + generator.uniform(-0.03, 0.03, 2)), 0.0])
        turn = shell.turn @ turn_z(generator.uniform(0.0, 2.0 * np.pi))
        add_group(things, contacts, group, turn, shell.turn @ place)
    return furnished(things, contacts, shell, generator, noise, hue)


def _mug(stock: Stock) -> Group:
    """Make a mug, and a spoon that leans in it."""
    about, colours, noise = stock.about, stock.colours, stock.noise
    outside, high = about(0.135), about(0.24)
    group, inside = standing(make_mug(stock, outside, high)), outside - MUG_WALL
    # In the plane y = 0, the spoon's round end lies on the mug's floor, and its shaft on the inner edge of the rim.
    shaft = 0.014
    start, rim = np.array([-0.55 * inside, MUG_FLOOR + shaft]), np.array([inside, high])
    reach = float(np.linalg.norm(rim - start))
    tilt = float(np.arctan2(rim[1] - start[1], rim[0] - start[0]) + np.arcsin(shaft / reach))
    lowest = 0.5 * np.pi - tilt  # angle from the pole of the end's lowest point, where a vertex must lie
    polar = np.concatenate([np.linspace(0.0, lowest, 4)[:-1], np.linspace(lowest, 0.5 * np.pi, 5)])
    length, bowl = about(0.42), 0.045
    end = np.stack([shaft * np.sin(polar), -shaft * np.cos(polar)], axis=1)
    end[0, 0] = 0.0
    swell = np.linspace(np.arcsin(shaft / bowl), np.pi, 16)
    head = np.stack([bowl * np.sin(swell), length + 0.07 * (np.cos(swell[0]) - np.cos(swell))], axis=1)
    head[-1, 0] = 0.0
    profile = np.concatenate([end, head])
    flat = np.concatenate([np.ones(len(end)), np.linspace(1.0, 0.3, 6), np.full(10, 0.3)])
    rotation = np.array([[np.sin(tilt), 0.0, np.cos(tilt)], [0.0, 1.0, 0.0], [-np.cos(tilt), 0.0, np.sin(tilt)]])
    turn = turn_z(0.75 * np.pi)  # angle from the handle, at which the mug has vertices
    grain = prints.wood(noise, *colours(), plank=0.05)
    tip = turn @ np.array([start[0], 0.0, start[1]])
    group.place("spoon", Mesh(lathe(profile, flat)), lambda p: grain(p[:, 2], p[:, 0]), tuple(tip), turn @ rotation)
    group.touch("spoon", "mug", *(turn @ [start[0], 0.0, MUG_FLOOR]))
    group.touch("spoon", "mug", *(turn @ [rim[0], 0.0, rim[1]]))
    return group


def _basket(stock: Stock) -> Group:
    """Make a basket with a hoop, and a ball that lies in it."""
    group, about, colours, noise = Group(), stock.about, stock.colours, stock.noise
    base, brim, high, thick = about(0.15), about(0.24), about(0.17), 0.026
    profile = [(0, 0), (base, 0), (brim, 0.7 * high), (brim, high), (brim - thick, high), (brim - thick, 0.7 * high),
               (base - 0.5 * thick, thick), (0, thick)]  # fmt: skip
    angle = np.linspace(0.0, np.pi, 49)
    middle = brim - 0.5 * thick
    hoop = np.stack([-middle * np.cos(angle), high - 0.03 + about(0.27) * np.sin(angle)], axis=1)
    straw = prints.weave(noise, *colours(), size=0.045)
    group.place("basket", Mesh(lathe(np.array(profile)), sweep(hoop, 0.011)), prints.around(straw, brim))
    group.touch("basket", "table", 0.0, 0.0, 0.0)
    ball = make_ball(stock)
    radius = -float(ball.solid.vertices[:, 2].min())
    group.place("ball", ball.solid, ball.texture, (0.0, 0.0, thick + radius))
    group.touch("ball", "basket", 0.0, 0.0, thick)
    return group


def _frame(stock: Stock) -> Group:
    """Make a standing frame with rounded corners and a hole."""
    group, about, colours, noise = Group(), stock.about, stock.colours, stock.noise
    wide, high, deep = about(0.22), about(0.2), about(0.055)
    outer = superellipse(wide, high, 3.5, 48)
    outer[:, 1] = np.maximum(outer[:, 1], -0.9 * high)
    band = extrude(outer, superellipse(0.72 * wide, 0.68 * high, 3.0, 48), -deep, deep)
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    tiles = prints.bricks(noise, colours()[0], colours()[1], 0.045)
    group.place("frame", Mesh(band), lambda p: tiles(p[:, 0] + p[:, 2], p[:, 1]), (0.0, 0.0, 0.9 * high), upright)
    group.touch("frame", "table", 0.0, 0.0, 0.0)
    return group


def room_views(seed: int, width: int, height: int, num_train: int, num_test: int) -> list[View]:
    """Make three passes along an arc in front of the table.

    Every fourth test view lies beyond the ends of the arc, and shows parts that photos hardly show.
    """
    generator = np.random.default_rng([seed, 2])
    turn = Shell.of(seed).turn
    total, tests = num_train + num_test, held_out(num_train, num_test)
    beyond = tests[2::4]
    views = []
    for i in range(total):
        progress = i * len(ELEVATIONS) / total
        level = int(progress)
        along = (2.0 * (progress - level) - 1.0) * (-1.0) ** level * ARC  # Every second pass goes back.
        spread = generator.uniform(-1.0, 1.0, 7)
        if i in beyond:
            along = np.copysign(ARC + 0.25 + 0.12 * spread[0], along)
        azimuth = along + 0.05 * spread[0] - 0.5 * np.pi
        elevation = ELEVATIONS[level] + 0.06 * spread[1]
        target = TARGET + 0.12 * spread[2:5] * [1.0, 1.0, 0.5]
        place = target + 2.15 * (1.0 + 0.08 * spread[5]) * direction(azimuth, elevation)
        pose = look_at(turn @ place, turn @ target, 0.04 * spread[6])
        views.append(make_view(i, i in tests, pose, 0.98, width, height))
    return views


class TracedLight(RoomLight):
    """The light of a room, measured by rays from each point that a photo shows."""

    def colours(
        self, points: np.ndarray, surface: np.ndarray, directions: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        albedo, normals = np.empty_like(points), np.empty_like(points)
        for which in np.unique(surface):
            on = np.flatnonzero(surface == which)
            if which == SHELL:
                albedo[on], normals[on] = self._shell(points[on])
            else:
                thing = self.room.part(which)
                local, way = thing.to_local(points[on]), turned(directions[on], thing.rotation)
                albedo[on] = thing.texture(local)
                normals[on] = turned(thing.solid.normals(local, way), thing.rotation.T)
        return albedo * self.light_at(points, normals, np.arange(len(points)) % SHARES)

    def _shell(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return albedo and normals of walls, floor and ceiling."""
        shell = self.room.shell
        local = shell.to_local(points)
        axis = np.argmax(np.abs(local) / shell.half, axis=1)
        rows = np.arange(len(points))
        normals = np.zeros_like(points)
        normals[rows, axis] = -np.sign(local[rows, axis])
        return self.paper(local), turned(normals, shell.turn.T)


ROOM = Family(make_room, TracedLight, room_views)
