"""Colours of surface points: diffuse reflection of a soft-edged sun and sky light, the same from every view."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.arrangement import DOME, DOME_RADIUS, GROUND, Still, make_still
from beags_plugin.sample.family import Family
from beags_plugin.sample.scene import Thing
from beags_plugin.sample.solids import Solid, dot, turned
from beags_plugin.sample.tracing import seen_share
from beags_plugin.sample.views import make_views

SUN = np.array([1.22, 1.13, 1.0])
SKY = np.array([0.36, 0.39, 0.44])
SUN_RADIUS = 0.10  # radians, which sets the width of penumbras
LIFT = 1e-4  # distance from the surface at which shadow rays start, so that they do not hit it; world units
TILES = 2.5  # tiles of the ground per unit
MAP_EXTENT, MAP_CELLS = 2.0, 160
"""The ground's light is baked for |x|, |y| <= 2.0 units; no shadow reaches farther."""


def _sun_directions(sun: np.ndarray, count: int) -> np.ndarray:
    """Return [count, 3] unit vectors, spread evenly over the sun's disc on a golden-angle spiral."""
    side = np.cross(sun, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, sun)
    radius = SUN_RADIUS * np.sqrt((np.arange(count) + 0.5) / count)
    angle = 2.399963 * np.arange(count)
    spread = sun + (radius * np.cos(angle))[:, None] * side + (radius * np.sin(angle))[:, None] * up
    return spread / np.linalg.norm(spread, axis=1, keepdims=True)


def _sky_directions(count: int) -> np.ndarray:
    """Return [count, 3] unit vectors around +z, with a density proportional to the cosine."""
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    angle = 2.399963 * np.arange(count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)], axis=1)


class Light:
    """The light of a still life, with that of the ground baked into a map once."""

    def __init__(self, still: Still, object_samples: int = 8, ground_samples: int = 24) -> None:
        self.still = still
        self._blockers = (*still.things, *still.fixtures)
        self._suns = _sun_directions(still.sun, object_samples)
        axis = np.linspace(-MAP_EXTENT, MAP_EXTENT, MAP_CELLS)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        points = np.stack([x.ravel(), y.ravel(), np.full(x.size, LIFT)], axis=1)

        self._sun_map = seen_share(self._blockers, points, _sun_directions(still.sun, ground_samples)).reshape(x.shape)
        self._sky_map = seen_share(self._blockers, points, _sky_directions(2 * ground_samples)).reshape(x.shape)

    def _read(self, table: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Read the baked map bilinearly; outside it, its border."""
        place = np.clip((points[:, :2] / MAP_EXTENT + 1.0) * 0.5 * (MAP_CELLS - 1), 0.0, MAP_CELLS - 1.001)
        low = place.astype(np.int64)
        fx, fy = (place - low).T
        i, j = low.T
        return (table[i, j] * (1 - fy) + table[i, j + 1] * fy) * (1 - fx) + (
            table[i + 1, j] * (1 - fy) + table[i + 1, j + 1] * fy
        ) * fx

    def _lit(self, albedo: np.ndarray, sun: np.ndarray, sky: np.ndarray) -> np.ndarray:
        return albedo * (sun[:, None] * SUN + sky[:, None] * SKY)

    def _standing(self, points: np.ndarray, center: np.ndarray) -> np.ndarray:
        """Return background points [N, 3] in the background's frame, as a camera at ``center`` [3] sees them."""
        return points

    def _ground(self, place: np.ndarray, center: np.ndarray) -> np.ndarray:
        """Return the colours of mottled stone tiles, whose pattern fades outwards, where small images would alias."""
        palette, noise = self.still.palette, self.still.noise
        points = self._standing(place, center)
        tile = points[:, :2] * TILES
        cell = np.floor(tile)
        flat = np.zeros_like(points)
        flat[:, :2] = cell * 3.7 + 0.5
        shade = noise(flat)  # a tone per tile
        flat[:, :2] = points[:, :2] * 7.0
        stone = noise(flat)
        flat[:, :2] = points[:, :2] * 2.3 + 9.1
        patch = noise(flat)
        fade = np.clip((DOME_RADIUS - np.hypot(points[:, 0], points[:, 1])) / (DOME_RADIUS - 1.0), 0.0, 1.0)
        odd = 0.5 + fade * ((cell[:, 0] + cell[:, 1]) % 2 - 0.5)
        albedo = palette[0] + odd[:, None] * (palette[1] - palette[0])
        albedo = albedo * (0.34 + 0.33 * fade * shade + 0.48 * stone + 0.33 * patch)[:, None]
        joint = fade * (np.max(np.abs(tile - cell - 0.5), axis=1) > 0.465)
        albedo = albedo * (1.0 - 0.5 * joint)[:, None]
        sun = self._read(self._sun_map, place) * self.still.sun[2]
        sky = 0.15 + 0.85 * self._read(self._sky_map, place)  # Some light is reflected everywhere.
        return self._lit(albedo, sun, sky)

    def _dome(self, points: np.ndarray, center: np.ndarray) -> np.ndarray:
        """Return the colours of a glowing curtain of soft folds and clouds of colour, without shading."""
        palette, noise = self.still.palette, self.still.noise
        points = self._standing(points, center)
        height = points[:, 2] / DOME_RADIUS
        cloud = noise(points * 1.1) * 0.6 + noise(points * 2.7 + 5.0) * 0.4
        weight = 0.5 + 0.5 * np.tanh(7.0 * (cloud - 0.5))
        azimuth = np.arctan2(points[:, 1], points[:, 0])
        fold = np.tanh(1.5 * np.sin(18.0 * azimuth + 5.0 * noise(points * 0.7 + 11.0)))
        colour = palette[2] + weight[:, None] * (palette[3] - palette[2])
        return colour * (0.62 + 0.4 * height + 0.2 * fold)[:, None]

    def _thing(self, thing: Thing[Solid], points: np.ndarray) -> np.ndarray:
        local = thing.to_local(points)
        normals = turned(thing.solid.normals(local), thing.rotation.T)
        cosine = dot(normals, self.still.sun[None])
        sun = np.zeros(len(points))
        bright = np.flatnonzero(cosine > 0.0)
        lifted = points[bright] + LIFT * normals[bright]
        sun[bright] = cosine[bright] * seen_share(self._blockers, lifted, self._suns)
        # Sky light depends on the tilt, and is dimmed near the ground in place of ambient occlusion.
        sky = (0.62 + 0.38 * normals[:, 2]) * (0.55 + 0.45 * np.clip(points[:, 2] / 0.25, 0.0, 1.0))
        return self._lit(thing.texture(local), sun, sky)

    def colours(
        self, points: np.ndarray, surface: np.ndarray, directions: np.ndarray, center: np.ndarray
    ) -> np.ndarray:
        colours = np.empty_like(points)
        for which in np.unique(surface):
            chosen = np.flatnonzero(surface == which)
            if which == DOME:
                colours[chosen] = self._dome(points[chosen], center)
            elif which == GROUND:
                colours[chosen] = self._ground(points[chosen], center)
            else:
                thing = self.still.things[which - 1] if which > 0 else self.still.fixtures[DOME - 1 - which]
                colours[chosen] = self._thing(thing, points[chosen])
        return colours


TABLETOP = Family(make_still, Light, make_views)
