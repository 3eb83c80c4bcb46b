"""The objects of a desk, alone or in groups that touch exactly."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from beags_plugin.sample import prints
from beags_plugin.sample.meshes import Mesh, block, extrude, lathe, sweep
from beags_plugin.sample.prints import Paint
from beags_plugin.sample.scene import Thing
from beags_plugin.sample.solids import turn_z, turned
from beags_plugin.sample.textures import Noise, linear_from_hsv

MUG_WALL, MUG_FLOOR = 0.022, 0.025
"""Thickness of the mug, world units."""


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


def standing(thing: Thing[Mesh]) -> Group:
    """Return a thing alone, upright on the table."""
    group = Group()
    group.place(thing.name, thing.solid, thing.texture, (0.0, 0.0, float(-thing.solid.vertices[:, 2].min())))
    group.touch(thing.name, "table", 0.0, 0.0, 0.0)
    return group


def make_crate(stock: Stock) -> Group:
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


def make_mug(stock: Stock, outside: float, high: float) -> Thing[Mesh]:
    """Make a mug of this radius and height, with a thin handle."""
    colours, noise = stock.colours, stock.noise
    inside = outside - MUG_WALL
    wall = lathe(np.array([(0, 0), (0.93 * outside, 0), (outside, 0.02), (outside, high), (inside, high),
                           (inside, MUG_FLOOR), (0, MUG_FLOOR)]))  # fmt: skip
    angle, reach = np.linspace(0.0, np.pi, 25), stock.about(0.10)
    bow = np.stack([outside - 0.012 + reach * np.sin(angle), 0.5 * high + 0.33 * high * np.cos(angle)], axis=1)
    print_ = prints.within(prints.plain(noise, colours()[0]), (0.0, 0.5 * high + 0.08, 9.0, 0.7 * high,
                           prints.lettering(noise, *colours(), size=0.035)))  # fmt: skip
    return _at_rest("mug", Mesh(wall, sweep(bow, 0.016)), prints.around(print_, outside))


def make_ball(stock: Stock) -> Thing[Mesh]:
    """Make a ball around the origin."""
    radius = stock.about(0.12)
    polar = np.linspace(0.0, np.pi, 33)
    ball = np.stack([radius * np.sin(polar), -radius * np.cos(polar)], axis=1)
    ball[[0, -1], 0] = 0.0
    light, dark = stock.colours()
    panels = prints.stripes(stock.noise, np.stack([light, dark, 1.0 - dark]), radius * np.pi / 5.0)
    return _at_rest("ball", Mesh(lathe(ball)), lambda p: panels(radius * np.arctan2(p[:, 1], p[:, 0]), p[:, 2]))


def make_vase(stock: Stock) -> Thing[Mesh]:
    """Make a vase with a narrow neck, open at the top."""
    about, colours = stock.about, stock.colours
    wide, high = about(0.14), about(0.46)
    up = np.linspace(0.0, 1.0, 40)
    radius = wide * (0.55 + 0.45 * np.sin(0.6 + 4.4 * up) + 0.25 * up**6)
    outer = np.stack([radius, high * up], axis=1)
    inner = outer[:9:-1] - [0.02, 0.0]
    profile = np.concatenate([[(0.0, 0.0)], outer, inner, [(0.0, inner[-1, 1])]])
    glaze = prints.stripes(stock.noise, np.stack([*colours(), colours()[0]]), 0.06)
    return _at_rest("vase", Mesh(lathe(profile)), prints.around(glaze, 0.5 * wide))


def _at_rest(name: str, mesh: Mesh, texture: Paint) -> Thing[Mesh]:
    return Thing(name, mesh, np.eye(3), np.zeros(3), texture)
