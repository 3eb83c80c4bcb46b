"""A closed room: walls, furniture and, on a table, objects that touch one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beags_plugin.sample import prints
from beags_plugin.sample.meshes import Mesh, Part, block, extrude, moved
from beags_plugin.sample.prints import Paint, Print
from beags_plugin.sample.room_things import Group, superellipse
from beags_plugin.sample.scene import Contact, Scene, Thing
from beags_plugin.sample.solids import turn_z, turned
from beags_plugin.sample.textures import Noise, linear_from_hsv
from beags_plugin.sample.tracing import hit_fixtures

SHELL = 0


@dataclass(frozen=True)
class Shell:
    """The inside of a box: world = turn @ (local + middle), |local| <= half."""

    turn: np.ndarray
    middle: np.ndarray
    half: np.ndarray

    @classmethod
    def of(cls, seed: int) -> Shell:
        """Return the walls of the room of a seed; the table stands near one of them (+y before the rotation)."""
        generator = np.random.default_rng([seed, 11])
        low = np.array([-3.1, -3.3, -1.3]) - generator.uniform(0.0, 0.4, 3) * [1.0, 1.0, 0.0]
        high = np.array([3.1, 1.9, 2.3]) + generator.uniform(0.0, 0.4, 3) * [1.0, 0.5, 0.5]
        return cls(turn_z(generator.uniform(0.0, 2.0 * np.pi)), 0.5 * (low + high), 0.5 * (high - low))

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """Return world points [N, 3] in the frame of the box."""
        return turned(points, self.turn) - self.middle


@dataclass(frozen=True)
class Room(Scene):
    """The walls, the other things of the background (part -1 - i is fixture i), and the walls' paint."""

    things: tuple[Thing[Mesh], ...]
    shell: Shell
    fixtures: tuple[Thing[Mesh], ...]
    walls: Paint

    def surround(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return hits of fixtures and walls; the origin must lie inside the room and outside of the fixtures."""
        local = turned(directions, self.shell.turn)
        room = np.copysign(self.shell.half, local) - self.shell.to_local(origin[None])
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.min(np.where(local == 0.0, np.inf, room / local), axis=1)
        part = np.full(len(t), SHELL, dtype=np.int32)
        return hit_fixtures(self.fixtures, origin, directions, t, part, SHELL - 1)

    def part(self, which: int) -> Thing[Mesh]:
        """Return the object of class id ``which``, or below 0 the fixture that is this part of the background."""
        return self.things[which - 1] if which > 0 else self.fixtures[-1 - which]


def furnished(
    things: list[Thing[Mesh]], contacts: list[Contact], shell: Shell, generator: np.random.Generator, noise: Noise,
    hue: float,
) -> Room:  # fmt: skip
    """Return a room with these things on its table."""
    return Room(
        things=tuple(things),
        contacts=tuple(contacts),
        shell=shell,
        fixtures=_fixtures(shell, generator, noise, hue),
        walls=_walls(shell.half, generator, noise, hue),
    )


def add_group(
    things: list[Thing[Mesh]], contacts: list[Contact], group: Group, turn: np.ndarray, place: np.ndarray
) -> None:
    """Add a group with its contacts, turned and then moved to ``place`` [3], to the things of a scene."""
    ids = {"table": 0}
    for thing in group.things:
        things.append(
            Thing(thing.name, thing.solid, turn @ thing.rotation, turn @ thing.position + place, thing.texture)
        )
        ids[thing.name] = len(things)
    contacts += [Contact(ids[a], ids[b], turn @ np.array(point) + place) for a, b, point in group.contacts]


def _fixtures(shell: Shell, generator: np.random.Generator, noise: Noise, hue: float) -> tuple[Thing[Mesh], ...]:
    """Return a table, whose top is z = 0, a cabinet at the wall and a rug."""
    floor = float(shell.middle[2] - shell.half[2])
    tone = linear_from_hsv(0.07 + 0.03 * generator.uniform(), 0.55, 0.75), linear_from_hsv(0.06, 0.75, 0.34)
    legs: list[Part] = [moved(block(0.06, 0.06, floor, -0.05), (x, y, 0.0)) for x in (-1.0, 1.0) for y in (-0.62, 0.62)]
    top = extrude(superellipse(1.28, 0.86, 6.0, 64), 0.0, -0.07, 0.0)
    oak = prints.wood(noise, *tone, plank=0.2)
    table = Thing("table", Mesh(top, *legs), shell.turn, np.zeros(3), lambda p: oak(p[:, 0] + 0.3 * p[:, 2], p[:, 1]))
    half = np.array([0.25, 0.75, generator.uniform(0.45, 0.6)])
    side = float(generator.choice([-1.0, 1.0]))
    corner = shell.middle + shell.half * [side, 1.0, -1.0] - half * [side, 1.0, -1.0] - [side * 1e-3, 0.3, -1e-3]
    front = prints.lettering(noise, linear_from_hsv(hue + 0.3, 0.35, 0.7), linear_from_hsv(hue, 0.7, 0.2), 0.07)
    planks = prints.wood(noise, linear_from_hsv(hue + 0.4, 0.3, 0.8), linear_from_hsv(hue + 0.4, 0.5, 0.4), 0.15)
    cabinet = Thing(
        "cabinet",
        Mesh(block(half[0], half[1], -half[2], half[2])),
        shell.turn,
        shell.turn @ corner,
        prints.faces(half, [front, front, planks, planks, planks, planks]),
    )
    colours = np.stack(
        [linear_from_hsv(hue + d, 0.7, v) for d, v in ((0.5, 0.7), (0.55, 0.3), (0.42, 0.9), (0.0, 0.5))]
    )
    weave = prints.carpet(noise, colours, 3.6, 2.8)
    rug = Thing(
        "rug",
        Mesh(block(1.8, 1.4, 0.0, 0.015)),
        shell.turn,
        shell.turn @ np.array([0.1, -0.6, floor]),
        lambda p: weave(p[:, 0], p[:, 1]),
    )
    return table, cabinet, rug


def _walls(half: np.ndarray, generator: np.random.Generator, noise: Noise, hue: float) -> Paint:
    """Return the paint of the walls, in the frame of the shell: -x, +x, -y, +y, floor, ceiling."""

    def palette(count: int) -> np.ndarray:
        return np.stack(
            [
                linear_from_hsv(generator.uniform(), generator.uniform(0.35, 0.8), generator.uniform(0.35, 0.95))
                for _ in range(count)
            ]
        )

    def picture(u: float, v: float, wide: float, high: float) -> tuple[float, float, float, float, Print]:
        return u, v, wide, high, prints.poster(noise, palette(4), wide, high)

    skirting = -half[2] + 0.08
    board = prints.wood(noise, linear_from_hsv(hue, 0.1, 0.9), linear_from_hsv(hue, 0.15, 0.75), 0.3)

    def wall(ground: Print, width: float, *panels: tuple[float, float, float, float, Print]) -> Print:
        return prints.within(ground, *panels, (0.0, skirting, 2.0 * width, 0.16, board))

    tones = ((0.0, 0.2), (0.04, 0.35), (0.5, 0.6))
    colours = np.stack([linear_from_hsv(hue + shift, saturation, 0.85) for shift, saturation in tones])
    paper = prints.stripes(noise, colours, 0.16)
    plaster = prints.plain(noise, linear_from_hsv(hue + 0.1, 0.25, 0.9))
    brick = prints.bricks(noise, linear_from_hsv(0.03, 0.62, 0.62), linear_from_hsv(0.1, 0.12, 0.75))
    page = prints.lettering(noise, linear_from_hsv(0.12, 0.1, 0.95), linear_from_hsv(hue + 0.6, 0.6, 0.15), 0.05)
    shelf = prints.spines(noise, palette(9))
    at = generator.uniform(-0.15, 0.15, 8)
    back = wall(
        paper, half[0],
        picture(-1.9 + at[0], 0.35 + at[1], 1.1, 1.4),
        picture(-0.35 + at[2], 0.45, 1.3, 0.95),
        (0.95 + at[3], 0.3, 0.75, 1.1, page),
        picture(2.2 + at[4], 0.35 + at[5], 1.0, 1.3),
    )  # fmt: skip
    left = wall(brick, half[1], picture(-1.0 + at[6], 0.4, 1.2, 0.9), picture(1.2, 0.5 + at[7], 0.9, 1.2))
    right = wall(plaster, half[1], (-0.8, 0.05, 2.3, 2.6, shelf), picture(1.4, 0.4, 1.1, 1.5))
    front = wall(plaster, half[0], (-1.6, -0.4, 1.3, 2.7, board), picture(0.9, 0.4, 1.7, 1.2))
    floor = prints.wood(noise, linear_from_hsv(0.08, 0.45, 0.72), linear_from_hsv(0.06, 0.65, 0.38), 0.26)
    ceiling = prints.plain(noise, linear_from_hsv(0.12, 0.06, 0.92), 0.12)
    sides = [left, right] if generator.uniform() < 0.5 else [right, left]
    return prints.faces(half, [*sides, front, back, floor, ceiling])
