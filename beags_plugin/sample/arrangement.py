"""The sample's still life: seven textured objects that touch, stand on and hide one another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.solids import Ball, Cone, Solid, Tube, slab, turned
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

DOME_RADIUS = 5.0
"""World units; the ground is the disc z = 0 of this radius, closed by the half-dome above it."""

HUE_RANGE = 0.25
"""Share of the colour circle that the objects' hues cover."""


@dataclass(frozen=True)
class Thing:
    """One object: world = rotation @ local + position.

    rotation: [3, 3]; position: [3], world units, z up.
    """

    name: str
    solid: Solid
    rotation: np.ndarray
    position: np.ndarray
    texture: Texture

    def to_local(self, points: np.ndarray) -> np.ndarray:
        """World points [N, 3] in the object's frame."""
        return turned(points - self.position, self.rotation)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """[N] bound of the signed distance of world points [N, 3] (sign and zeros exact)."""
        return self.solid.distance(self.to_local(points))


@dataclass(frozen=True)
class Contact:
    """A world point [3] on the surfaces of both objects; 0 is the ground, i the object of class id i."""

    first: int
    second: int
    point: np.ndarray


@dataclass(frozen=True)
class Still:
    """The whole scene: object i has class id i + 1; the ground and the dome around it are class 0.

    sun: [3] unit vector towards the light. noise: of the ground and the dome. palette: [4, 3] linear RGB of both.
    """

    things: tuple[Thing, ...]
    contacts: tuple[Contact, ...]
    sun: np.ndarray
    noise: Noise
    palette: np.ndarray

    @property
    def class_names(self) -> dict[int, str]:
        """Class id to name, the background included."""
        return {0: "background", **{i: thing.name for i, thing in enumerate(self.things, start=1)}}


def _turn_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _textures(names: list[str], generator: np.random.Generator) -> dict[str, Texture]:
    noise = Noise(generator)
    # Related hues, dealt out at random: colour alone does not tell where one object ends and the next begins.
    hues = generator.uniform() + HUE_RANGE * (generator.permutation(len(names)) / len(names) - 0.5)
    patterns = {
        "box": checks(6.5),
        "cone": bands(7.0, twist=1.0),
        "cylinder": sectors(6, slant=9.0),
        "ring": sectors(9),
        "bowl": blotches(noise, 10.0),
        "ball": marble(noise, 4.5),
        "plank": bands(6.0),
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
    """The scene of a seed: sizes, places, turn, handedness, colours, textures and light all depend on it.

    It is built about a low box at the origin that carries others (its faces are x = +-hx and y = +-hy), then moved to
    the middle, mirrored or not, and turned.
    """
    generator = np.random.default_rng([seed, 1])

    def about(value: float, spread: float = 0.08) -> float:
        return float(value * generator.uniform(1.0 - spread, 1.0 + spread))

    solids: dict[str, Solid] = {}
    poses: dict[str, tuple[np.ndarray, np.ndarray]] = {}
    contacts: list[tuple[str, str, np.ndarray]] = []

    def place(name: str, solid: Solid, position: list[float], rotation: np.ndarray | None = None) -> None:
        solids[name] = solid
        poses[name] = (_turn_z(0.0) if rotation is None else rotation, np.array(position))

    def touch(first: str, second: str, point: list[float]) -> None:
        contacts.append((first, second, np.array(point)))

    hx, hy, top = about(0.45, 0.04), about(0.40, 0.04), about(0.26)
    box = (*slab(0, -hx, hx), *slab(1, -hy, hy), *slab(2, -top / 2, top / 2))
    place("box", Solid(box, bound=float(np.linalg.norm([hx, hy, top / 2]))), [0.0, 0.0, top / 2])
    touch("box", "ground", [0.0, 0.0, 0.0])

    # Four things stand on the box, each in its quarter: what lies inside the box no photo shows, so nothing but their
    # class keeps their Gaussians out of it.
    def quarter(x: float, y: float) -> tuple[float, float]:
        return x + generator.uniform(-0.02, 0.02), y + generator.uniform(-0.02, 0.02)

    radius, height = about(0.14), about(0.36)
    x, y = quarter(-0.24, 0.19)
    cone = Solid((Cone(radius, height), *slab(2, 0.0, height)), bound=max(radius, height))
    place("cone", cone, [x, y, top], _turn_z(generator.uniform(0.0, 2.0 * np.pi)))
    touch("cone", "box", [x, y, top])

    radius, height = about(0.125), about(0.42)
    x, y = quarter(0.25, 0.20)
    can = Solid((Tube(radius), *slab(2, -height / 2, height / 2)), bound=float(np.hypot(radius, height / 2)))
    place("cylinder", can, [x, y, top + height / 2], _turn_z(generator.uniform(0.0, 2.0 * np.pi)))
    touch("cylinder", "box", [x, y, top])

    radius = about(0.14)
    x, y = quarter(0.22, -0.19)
    place("ball", Solid((Ball(radius),), bound=radius), [x, y, top + radius])
    touch("ball", "box", [x, y, top])

    radius, half, angle = about(0.16), about(0.045), generator.uniform(0.0, np.pi)
    x, y = quarter(-0.21, -0.18)
    ring = Solid((Tube(radius), *slab(2, -half, half)), (Tube(0.76 * radius),), float(np.hypot(radius, half)))
    across = np.array([np.cos(angle), np.sin(angle), 0.0])
    axis = np.array([-np.sin(angle), np.cos(angle), 0.0])
    place("ring", ring, [x, y, top + radius], np.stack([across, np.array([0.0, 0.0, -1.0]), axis], axis=1))
    touch("ring", "box", [x, y, top])

    # The bowl stands free before the face y = -hy; its foot is flat.
    radius = about(0.28, 0.05)
    inner = 0.9 * radius
    foot = inner + 0.02
    bowl_at = [generator.uniform(-0.06, 0.06), -hy - radius - about(0.2), foot]
    bowl = Solid((Ball(radius), *slab(2, -foot, 0.1 * radius)), (Ball(inner),), radius)
    place("bowl", bowl, bowl_at)
    touch("bowl", "ground", [bowl_at[0], bowl_at[1], 0.0])

    # The plank leans with the middle of its upper edge against the upright edge (-hx, hy).
    wide, thick, long, tilt = about(0.13), 0.018, about(0.15), generator.uniform(0.6, 0.75)
    way = generator.uniform(2.15, 2.55)
    out, along = np.array([np.cos(way), np.sin(way), 0.0]), np.array([np.sin(way), -np.cos(way), 0.0])
    c, s = np.cos(tilt), np.sin(tilt)
    up = c * np.array([0.0, 0.0, 1.0]) - s * out
    normal = s * np.array([0.0, 0.0, 1.0]) + c * out
    leans = np.array([-hx, hy, 2.0 * long * c])
    plank = Solid(
        (*slab(0, -wide, wide), *slab(1, -thick, thick), *slab(2, -long, long)),
        bound=float(np.hypot(wide, long) + thick),
    )
    centre = leans - long * up + thick * normal
    place("plank", plank, list(centre), np.stack([along, normal, up], axis=1))
    touch("plank", "box", list(leans))
    touch("plank", "ground", list(centre - long * up - thick * normal))

    return _finish(solids, poses, contacts, generator)


def _finish(
    solids: dict[str, Solid],
    poses: dict[str, tuple[np.ndarray, np.ndarray]],
    contacts: list[tuple[str, str, np.ndarray]],
    generator: np.random.Generator,
) -> Still:
    """Moves the scene to the middle, mirrors and turns it, and gives it colours and light."""
    # All solids are symmetric about their own y = 0, so mirroring a pose (M R M, M t) mirrors the object exactly.
    mirror = np.diag([1.0, generator.choice([-1.0, 1.0]), 1.0])
    turn = _turn_z(generator.uniform(0.0, 2.0 * np.pi))
    shift = np.array([0.0, 0.24, 0.0])
    names = list(solids)
    textures = _textures(names, generator)
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
    hue, height, azimuth = generator.uniform(), generator.uniform(0.70, 0.85), generator.uniform(0.0, 2.0 * np.pi)
    return Still(
        things=things,
        contacts=tuple(Contact(ids[a], ids[b], turn @ mirror @ (p + shift)) for a, b, p in contacts),
        sun=np.array([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]),
        noise=Noise(generator),
        palette=np.stack(
            [
                linear_from_hsv(hue, 0.09, 0.88),
                linear_from_hsv(hue + 0.06, 0.16, 0.62),
                linear_from_hsv(hue + 0.5, 0.22, 0.80),
                linear_from_hsv(hue + 0.58, 0.34, 0.52),
            ]
        ),
    )
