"""Seed points like those of structure from motion, and the photos that show each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.scene import Scene
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import Picture, View

SAME = 1e-6  # relative rounding error of the distance at which a ray ends


@dataclass(frozen=True)
class Photo:
    """A training photo: its camera and its scene."""

    view: View
    scene: Scene


@dataclass(frozen=True)
class SeedPoints:
    """Seed points of one photo.

    records: [P] of x, y, z (float32, world) and red, green, blue, with noise. places: [P, 3] world, without noise.
    pixels: [P] indices of the photo's pixels, row by row. on_objects: [P] bool.
    """

    records: np.ndarray
    places: np.ndarray
    pixels: np.ndarray
    on_objects: np.ndarray

    def paint(self, colours: np.ndarray) -> None:
        """Set the points' colours [P, 3] uint8."""
        for channel, name in enumerate(("red", "green", "blue")):
            self.records[name] = colours[:, channel]


def seed_points(
    view: View, picture: Picture, lasting: np.ndarray, count: int, noise: float, generator: np.random.Generator
) -> SeedPoints:
    """Sample ``count`` visible surface points of a view with noise, half of them on objects, if there are any.

    lasting: [H, W] bool, the background's pixels to sample from. noise: standard deviation, world units.
    """
    labels = picture.labels.ravel()
    objects, rest = np.flatnonzero(labels > 0), np.flatnonzero((labels == 0) & lasting.ravel())
    on_objects = count // 2 if len(objects) else 0
    on_objects = on_objects if len(rest) else count
    pixels = np.concatenate(
        [generator.choice(pool, n) for pool, n in ((objects, on_objects), (rest, count - on_objects)) if n]
    )
    x, y = pixels % view.width + 0.5, pixels // view.width + 0.5
    places = view.center + picture.depth.ravel()[pixels, None].astype(np.float64) * view.directions(x, y)
    noisy = places + generator.normal(0.0, noise, places.shape)
    records = np.empty(len(pixels), dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for axis, name in enumerate("xyz"):
        records[name] = noisy[:, axis]
    points = SeedPoints(records, places, pixels, labels[pixels] > 0)
    points.paint(picture.image.reshape(-1, 3)[pixels])
    return points


def shown_in(photo: Photo, points: np.ndarray) -> np.ndarray:
    """Return [P] bool: which world points [P, 3] of the scene's surfaces a photo shows."""
    view = photo.view
    local = (points - view.center) @ view.camera_to_world[:3, :3]
    front = np.flatnonzero(local[:, 2] < 0)
    depth = -local[front, 2]
    columns = np.floor(view.cx + view.focal * local[front, 0] / depth)
    rows = np.floor(view.cy - view.focal * local[front, 1] / depth)
    inside = front[(columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)]
    hits, _ = first_hits(photo.scene, view.center, points[inside] - view.center)
    visible = np.zeros(len(points), dtype=bool)
    visible[inside] = hits.t > 1.0 - SAME
    return visible


def find_tracks(seeds: Sequence[SeedPoints], photos: Sequence[Photo], turns: bool) -> list[list[int]]:
    """Return, for all points of ``seeds``, the indices of the photos that show each: its own, and others.

    seeds: the points of each photo. turns: whether the background stands still with the camera, so that its points have
    no fixed position.
    """
    places = np.concatenate([each.places for each in seeds])
    own = np.repeat(np.arange(len(seeds)), [len(each.places) for each in seeds])
    visible = np.stack([shown_in(photo, places) for photo in photos], axis=1)
    if turns:
        visible &= np.concatenate([each.on_objects for each in seeds])[:, None]
    visible[np.arange(len(places)), own] = True  # Rounding may hide a point from the photo that it was sampled from.
    return [np.flatnonzero(row).tolist() for row in visible]
