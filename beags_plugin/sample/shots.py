"""Differences between the photos of one scene: a thing that moved, exposure and white balance."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.exposure import Exposed, photo_gains
from beags_plugin.sample.family import Family
from beags_plugin.sample.lots import lowest_lots
from beags_plugin.sample.scene import Lighting, Scene
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import Picture, View, pixel_directions, render_view
from beags_plugin.sample.visitors import with_visitor

AHEAD = 2  # pictures that are rendered at the same time, each by a thread


@dataclass(frozen=True)
class Shot:
    """One photo to take.

    still: the scene that all photos show. scene: the same with the visitor, if this photo has one. light: the light of
    ``scene``, at the mean exposure. exposed: the light as this photo records it, or ``light`` itself if it is the same.
    """

    view: View
    still: Scene
    scene: Scene
    light: Lighting
    exposed: Lighting

    def lasting(self, picture: Picture) -> np.ndarray:
        """Return [H, W] bool: the pixels of ``picture`` that do not show the visitor."""
        if self.scene is self.still:
            return np.ones(picture.labels.shape, dtype=bool)
        hits, _ = first_hits(self.still, self.view.center, pixel_directions(self.view))
        return picture.depth == hits.t.astype(np.float32).reshape(picture.depth.shape)


def plan_shots(
    family: Family, seed: int, views: list[View], exposure: float, white_balance: float, moved: int
) -> list[Shot]:
    """Return a shot for each view; the seed and the names of the training photos decide which have the visitor.

    exposure, white_balance: see ``photo_gains``. moved: number of training photos with the visitor.
    """
    still = family.scene(seed)
    light = family.light(still)
    train, held_out = ([view.name for view in views if view.split == split] for split in ("train", "test"))
    visited = lowest_lots(train, seed, moved, 13)
    gains = photo_gains(train, held_out, seed, exposure, white_balance)
    shots = []
    for view in views:
        scene = with_visitor(still, view, seed) if view.name in visited else still
        own = light if scene is still else family.light(scene)
        exposed = own if (gains[view.name] == 1.0).all() else Exposed(own, gains[view.name])
        shots.append(Shot(view, still, scene, own, exposed))
    return shots


def taken(shots: Sequence[Shot], samples: int) -> Iterator[tuple[Shot, Picture]]:
    """Yield each shot with its picture, in order, while the next ones are rendered; samples: see ``render_view``."""
    waiting: deque[tuple[Shot, Future[Picture]]] = deque()
    with ThreadPoolExecutor(AHEAD) as pool:
        for shot in shots:
            waiting.append((shot, pool.submit(render_view, shot.scene, shot.exposed, shot.view, samples)))
            if len(waiting) > AHEAD:
                first, picture = waiting.popleft()
                yield first, picture.result()
        for last, picture in waiting:
            yield last, picture.result()
