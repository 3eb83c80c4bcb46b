"""The photos to take of a scene, and their pictures, some of which are rendered at the same time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from beags_plugin.sample.scene import Lighting, Scene
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import Picture, View, pixel_directions, render_view

AHEAD = 2  # pictures that are rendered at the same time, each by a thread


@dataclass(frozen=True)
class Shot:
    """One photo to take.

    still: the scene that all photos show. scene: the same with what this photo alone shows. light: the light of
    ``scene``, at the mean exposure. exposed: the light as this photo records it, or ``light`` itself if it is the same.
    """

    view: View
    still: Scene
    scene: Scene
    light: Lighting
    exposed: Lighting

    def lasting(self, picture: Picture) -> np.ndarray:
        """Return [H, W] bool: the pixels of ``picture`` that show the scene of all photos."""
        if self.scene is self.still:
            return np.ones(picture.labels.shape, dtype=bool)
        hits, _ = first_hits(self.still, self.view.center, pixel_directions(self.view))
        return picture.depth == hits.t.astype(np.float32).reshape(picture.depth.shape)


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
