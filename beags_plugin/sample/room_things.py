"""The objects of a room, in groups that touch exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beags_plugin.sample import prints
from beags_plugin.sample.arrangement import turn_z
from beags_plugin.sample.meshes import Mesh, block, extrude, lathe, sweep
from beags_plugin.sample.prints import Paint
from beags_plugin.sample.scene import Thing
from beags_plugin.sample.solids import turned
from beags_plugin.sample.textures import Noise, linear_from_hsv


@dataclass
class Group:
    """Things that touch, around (0, 0, 0) on the table, and their contacts: both names ("table" too) and the point."""

    things: list[Thing[Mesh]] = field(default_factory=list)
    contacts: list[tuple[str, str, tuple[float, float, float]]] = field(default_factory=list)

    def place(self, name: str, mesh: Mesh, texture: Paint, position: tuple[float, float, float] = (0.0, 0.0, 0.0),
              rotation: np.ndarray | None = None) -> None:  # fmt: skip
        """Add a thing."""
        turn = np.eye(3) if rotation is None else rotation
        self.things.append(Thing(name, mesh, turn, np.array(position), texture))

    def touch(self, first: str, second: str, x: float, y: float, z: float) -> None:
        """Add a contact."""
        self.contacts.append((first, second, (x, y, z)))


def superellipse(x: float, y: float, power: float, count: int) -> np.ndarray:
    """Return the outline [count, 2] of |u / x|^power + |v / y|^power = 1, anticlockwise."""
    angle = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    c, s = np.cos(angle), np.sin(angle)
    radius = (np.abs(c) ** power + np.abs(s) ** power) ** (-1.0 / power)
    return np.stack([x * radius * c, y * radius * s], axis=1)


@dataclass(frozen=True)
class Stock:
    """Random sizes, colours within ``spread`` turns of one hue, and the noise of prints, to make things with."""

    generator: np.random.Generator
    noise: Noise
    hue: float
    spread: float = 0.2

    def about(self, value: float) -> float:
        """Return a size that differs from ``value`` by up to 8 %."""
        return float(value * self.generator.uniform(0.92, 1.08))

    def colours(self) -> tuple[np.ndarray, np.ndarray]:
        """Return a light and a dark colour, linear RGB, alike enough that colour alone does not separate objects."""
        tint = self.hue + self.generator.uniform(-self.spread, self.spread)
        return linear_from_hsv(tint, self.generator.uniform(0.3, 0.6), 0.9), linear_from_hsv(tint + 0.08, 0.7, 0.36)


def make_groups(stock: Stock) -> list[Group]:
    """Make all groups."""
    return [make(stock) for make in (_crate, _mug, _basket, _vase, _frame)]


def _crate(stock: Stock) -> Group:
    """Make a crate, a book that leans on it, and a star that lies on it."""
    group, about, colours, noise = Group(), stock.about, stock.colours, stock.noise
    x, y, top = about(0.20), about(0.15), about(0.30)
    west = -0.10  # x of the crate, so that the group surrounds its origin
    planks = prints.wood(noise, *colours(), plank=0.1)
    label = prints.within(planks, (0.0, 0.0, 0.2, 0.12, prints.lettering(noise, *colours(), size=0.024)))
    half = (x, y, 0.5 * top)
    crate = prints.faces(half, [label, label, label, label, planks, planks])
    group.place("crate", Mesh(block(x, y, -0.5 * top, 0.5 * top)), crate, (west, 0.0, 0.5 * top))
    group.touch("crate", "table", west, 0.0, 0.0)
    foot, edge = np.array([west + x + about(0.13), 0.0]), np.array([west + x, top])
    lean = (edge - foot) / np.linalg.norm(edge - foot)
    across = np.array([lean[1], -lean[0]])  # normal of the book, away from the crate
    thick, wide, long = about(0.022), about(0.13), about(0.205)
    middle = foot + thick * across + long * lean
    rotation = np.array([[across[0], 0.0, lean[0]], [0.0, 1.0, 0.0], [across[1], 0.0, lean[1]]])
    cover = prints.poster(noise, np.stack([*colours(), *colours()]), 2.0 * wide, 2.0 * long)
    pages = prints.lettering(noise, np.array([0.8, 0.76, 0.66]), np.array([0.5, 0.45, 0.36]), 0.02)
    book = prints.faces((thick, wide, long), [cover, cover, pages, pages, pages, pages])
    group.place("book", Mesh(block(thick, wide, -long, long)), book, (middle[0], 0.0, middle[1]), rotation)
    group.touch("book", "table", foot[0], 0.0, 0.0)
    group.touch("book", "crate", edge[0], 0.0, edge[1])
    spikes, height = about(0.14), about(0.06)
    angle = np.pi * np.arange(10) / 5.0
    radius = np.where(np.arange(10) % 2 == 0, spikes, 0.45 * spikes)
    star = extrude(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), 0.0, 0.0, height)
    checks = prints.weave(noise, *colours(), size=0.05)
    slant = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    group.place("star", Mesh(star), lambda p: checks(*turned(p, slant).T), (west, 0.0, top), turn_z(0.3))
    group.touch("star", "crate", west, 0.0, top)
    return group


def _mug(stock: Stock) -> Group:
    """Make a mug with a thin handle, and a spoon that leans in it."""
    group, about, colours, noise = Group(), stock.about, stock.colours, stock.noise
    outside, high = about(0.135), about(0.24)
    inside, floor = outside - 0.022, 0.025
    wall = lathe(np.array([(0, 0), (0.93 * outside, 0), (outside, 0.02), (outside, high), (inside, high),
                           (inside, floor), (0, floor)]))  # fmt: skip
    angle = np.linspace(0.0, np.pi, 25)
    bow = np.stack([outside - 0.012 + about(0.10) * np.sin(angle), 0.5 * high + 0.33 * high * np.cos(angle)], axis=1)
    print_ = prints.within(prints.plain(noise, colours()[0]), (0.0, 0.5 * high + 0.08, 9.0, 0.7 * high,
                           prints.lettering(noise, *colours(), size=0.035)))  # fmt: skip
    group.place("mug", Mesh(wall, sweep(bow, 0.016)), prints.around(print_, outside))
    group.touch("mug", "table", 0.0, 0.0, 0.0)

    # In the plane y = 0, the spoon's round end lies on the mug's floor, and its shaft on the inner edge of the rim.
    shaft = 0.014
    start, rim = np.array([-0.55 * inside, floor + shaft]), np.array([inside, high])
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
    group.touch("spoon", "mug", *(turn @ [start[0], 0.0, floor]))
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
    radius = about(0.12)
    polar = np.linspace(0.0, np.pi, 33)
    ball = np.stack([radius * np.sin(polar), -radius * np.cos(polar)], axis=1)
    ball[[0, -1], 0] = 0.0
    light, dark = colours()
    panels = prints.stripes(noise, np.stack([light, dark, 1.0 - dark]), radius * np.pi / 5.0)
    group.place("ball", Mesh(lathe(ball)), lambda p: panels(radius * np.arctan2(p[:, 1], p[:, 0]), p[:, 2]),
                (0.0, 0.0, thick + radius))  # fmt: skip
    group.touch("ball", "basket", 0.0, 0.0, thick)
    return group


def _vase(stock: Stock) -> Group:
    """Make a vase with a narrow neck, open at the top."""
    group, about, colours, noise = Group(), stock.about, stock.colours, stock.noise
    wide, high = about(0.14), about(0.46)
    up = np.linspace(0.0, 1.0, 40)
    radius = wide * (0.55 + 0.45 * np.sin(0.6 + 4.4 * up) + 0.25 * up**6)
    outer = np.stack([radius, high * up], axis=1)
    inner = outer[:9:-1] - [0.02, 0.0]
    profile = np.concatenate([[(0.0, 0.0)], outer, inner, [(0.0, inner[-1, 1])]])
    glaze = prints.stripes(noise, np.stack([*colours(), colours()[0]]), 0.06)
    group.place("vase", Mesh(lathe(profile)), prints.around(glaze, 0.5 * wide))
    group.touch("vase", "table", 0.0, 0.0, 0.0)
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
