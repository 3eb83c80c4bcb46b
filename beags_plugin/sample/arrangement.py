"""The sample's still life: seven textured objects that touch, stand on and hide one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.scene import Contact, Scene, Thing
from beags_plugin.sample.solids import Ball, Cone, Primitive, Solid, Tube, dot, slab, turn_z
from beags_plugin.sample.textures import (
    Noise,
    Texture,
    bands,
    blotches,
    checks,
    linear_from_hsv,
    marble,
    sectors,
)
from beags_plugin.sample.tracing import hit_fixtures

DOME_RADIUS = 5.0
"""Radius of the ground, the disc z = 0, and of the half-dome above it, world units."""

GROUND, DOME = 0, -1
HUE_RANGE = 0.12
"""Share of the colour circle that the hues of the objects cover; the ground's hue lies among them."""


@dataclass(frozen=True)
class Still(Scene):
    """The whole scene, on the ground under a dome.

    sun: [3] unit vector towards the light. noise: that of the ground and the dome. palette: [4, 3] linear RGB of both.
    fixtures: things of the background; fixture i is its part -2 - i.
    """

    things: tuple[Thing[Solid], ...]
    sun: np.ndarray
    noise: Noise
    palette: np.ndarray
    fixtures: tuple[Thing[Solid], ...] = ()

    def surround(self, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return hits of fixtures, the ground or, beyond its edge, the dome; the origin must lie inside."""
        a = dot(directions, directions)
        half_b = dot(directions, origin[None])
        t = (-half_b + np.sqrt(half_b * half_b - a * (origin @ origin - DOME_RADIUS**2))) / a
        with np.errstate(divide="ignore"):
            ground = np.where(directions[:, 2] < 0.0, -origin[2] / directions[:, 2], np.inf)
        part = np.where(ground < t, GROUND, DOME).astype(np.int32)
        return hit_fixtures(self.fixtures, origin, directions, np.minimum(t, ground), part, DOME - 1)


def _textures(names: list[str], hue: float, noise: Noise, generator: np.random.Generator) -> dict[str, Texture]:
    # The hues are alike and assigned at random, so that colour alone does not separate the objects.
    hues = hue + HUE_RANGE * (generator.permutation(len(names)) / len(names) - 0.5)
    patterns = {
        "box": checks(6.5),
        "cone": bands(7.0, twist=1.0),
        "cylinder": sectors(6, slant=9.0),
        "ring": sectors(9),
        "cup": blotches(noise, 10.0),
        "dome": marble(noise, 4.5),
        "tile": marble(noise, 3.0),
    }
    textures = {}
    for name, hue in zip(names, hues, strict=True):
        textures[name] = Texture(
            pattern=patterns[name],
            light=linear_from_hsv(hue + 0.02, 0.42, 0.98),
            dark=linear_from_hsv(hue - 0.02, 0.88, 0.70),
            fleck=linear_from_hsv(hue + 0.09, 0.65, 0.45),
            noise=noise,
        )
    return textures


def make_still(seed: int) -> Still:
    """Make the scene of a seed, which decides sizes, positions, rotation, mirroring, colours, textures and light.

    All objects stand on flat faces, which no photo shows: only their class keeps Gaussians out of the surface below.
    The scene is built around a box at the origin, then moved to the middle, perhaps mirrored, and turned.
    """
    generator = np.random.default_rng([seed, 1])

    def about(value: float, spread: float = 0.08) -> float:
        return float(value * generator.uniform(1.0 - spread, 1.0 + spread))

    solids: dict[str, Solid] = {}
    poses: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    contacts: list[tuple[str, str, np.ndarray]] = []

    def place(name: str, solid: Solid, position: list[float], rotation: np.ndarray | None = None) -> None:
        solids[name] = solid
        poses[name] = (turn_z(0.0) if rotation is None else rotation, np.array(position))

    def touch(first: str, second: str, point: list[float]) -> None:
        contacts.append((first, second, np.array(point)))

    def upright(name: str, outline: tuple[Primitive, ...], cut: tuple[Primitive, ...], reach: float, half: float,
                position: tuple[float, float, float], on: str) -> None:  # fmt: skip
        """Place a solid around its own z axis, 2 half high, within ``reach`` of it, with its foot at ``position``."""
        x, y, z = position
        solid = Solid((*outline, *slab(2, -half, half)), cut, bound=float(np.hypot(reach, half)))
        place(name, solid, [x, y, z + half], turn_z(generator.uniform(0.0, 2.0 * np.pi)))
        touch(name, on, [x + 0.9 * reach, y, z])  # The foot of a hollow solid contains this point too.

    hx, hy, top = about(0.24, 0.04), about(0.20, 0.04), about(0.30)
    box = (*slab(0, -hx, hx), *slab(1, -hy, hy), *slab(2, -top / 2, top / 2))
    place("box", Solid(box, bound=float(np.linalg.norm([hx, hy, top / 2]))), [0.0, 0.0, top / 2])
    touch("box", "ground", [0.0, 0.0, 0.0])

    radius, half = about(0.13), about(0.16)
    upright("cylinder", (Tube(radius),), (), radius, half, (0.03, 0.02, top), "box")

    radius, height = about(0.19), about(0.40)
    cone_at = [0.62, 0.16, 0.0]
    cone = Solid((Cone(radius, height), *slab(2, 0.0, height)), bound=max(radius, height))
    place("cone", cone, cone_at, turn_z(generator.uniform(0.0, 2.0 * np.pi)))
    touch("cone", "ground", cone_at)

    radius, half = about(0.18), about(0.13)
    hollow = (Tube(0.82 * radius), *slab(2, -0.8 * half, 2.0 * half))
    upright("cup", (Tube(radius),), hollow, radius, half, (-0.62, -0.12, 0.0), "ground")

    radius = about(0.20)
    dome_at = [-0.18, -0.62, 0.0]
    place("dome", Solid((Ball(radius), *slab(2, 0.0, radius)), bound=radius), dome_at)
    touch("dome", "ground", dome_at)

    radius, half = about(0.22), about(0.055)
    upright("ring", (Tube(radius),), (Tube(0.6 * radius),), radius, half, (0.42, -0.48, 0.0), "ground")

    # The tile lies with one edge along the box's face y = hy.
    wide, thick, long = about(0.17), 0.018, about(0.22)
    tile = (*slab(0, -wide, wide), *slab(1, -long, long), *slab(2, -thick, thick))
    tile_at = [0.06, hy + long, thick]
    place("tile", Solid(tile, bound=float(np.linalg.norm([wide, long, thick]))), tile_at)
    touch("tile", "box", [tile_at[0], hy, thick])
    touch("tile", "ground", [tile_at[0], tile_at[1], 0.0])

    return _finish(solids, poses, contacts, generator)


def _finish(
    solids: dict[str, Solid],
    poses: dict[str, tuple[np.ndarray, np.ndarray]],
    contacts: list[tuple[str, str, np.ndarray]],
    generator: np.random.Generator,
) -> Still:
    """Move the scene to the middle, mirror and turn it, and add colours and light."""
    # All solids are symmetric about their own y = 0, so mirroring a pose (M R M, M t) mirrors the object exactly.
    mirror = np.diag([1.0, generator.choice([-1.0, 1.0]), 1.0])
    turn = turn_z(generator.uniform(0.0, 2.0 * np.pi))
    shift = np.array([0.0, 0.1, 0.0])
    names = list(solids)
    noise = Noise(generator)
    hue = generator.uniform()
    textures = _textures(names, hue, noise, generator)
    things = tuple(
        Thing(
            name,
            solids[name],
            turn @ mirror @ poses[name][0] @ mirror,
            turn @ mirror @ (poses[name][1] + shift),
            textures[name],
        )
        for name in names
    )
    ids = {"ground": 0, **{name: i for i, name in enumerate(names, start=1)}}
    height, azimuth = generator.uniform(0.70, 0.85), generator.uniform(0.0, 2.0 * np.pi)
    return Still(
        things=things,
        contacts=tuple(Contact(ids[a], ids[b], turn @ mirror @ (p + shift)) for a, b, p in contacts),
        sun=np.array([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]),
        noise=Noise(generator),
        palette=np.stack(
            [
                linear_from_hsv(hue, 0.40, 0.88),
                linear_from_hsv(hue + 0.06, 0.60, 0.62),
                linear_from_hsv(hue + 0.5, 0.22, 0.80),
                linear_from_hsv(hue + 0.58, 0.34, 0.52),
            ]
        ),
    )
