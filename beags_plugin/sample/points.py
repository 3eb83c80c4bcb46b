"""Seed points such as structure from motion would give."""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.views import Picture, View


def seed_points(view: View, picture: Picture, count: int, noise: float, generator: np.random.Generator) -> np.ndarray:
    """Sample ``count`` visible surface points of a view with noise, half of them on objects, where there are any.

    noise: standard deviation, world units. Returns [count] records of x, y, z (float32, world) and red, green, blue.
    """
    labels = picture.labels.ravel()
    objects, rest = np.flatnonzero(labels > 0), np.flatnonzero(labels == 0)
    on_objects = count // 2 if len(objects) else 0
    on_objects = on_objects if len(rest) else count
    pixels = np.concatenate(
        [generator.choice(pool, n) for pool, n in ((objects, on_objects), (rest, count - on_objects)) if n]
    )
    x, y = pixels % view.width + 0.5, pixels // view.width + 0.5
    points = view.center + picture.depth.ravel()[pixels, None].astype(np.float64) * view.directions(x, y)
    points = points + generator.normal(0.0, noise, points.shape)
    records = np.empty(len(pixels), dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for axis, name in enumerate("xyz"):
        records[name] = points[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        records[name] = picture.image.reshape(-1, 3)[pixels, channel]
    return records
