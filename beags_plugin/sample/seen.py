"""Find the part of an object's silhouette whose surface the training photos show.

Where objects touch, photos show their surfaces nowhere, or only through a gap. An evaluation may leave such pixels of
the silhouette out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from beags_plugin.sample.scene import Scene
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import Picture, View, pixel_directions

MIN_VIEWS = 6  # photos that must show a patch of surface; fewer, through a gap, do not determine its position
PATCH = 0.03  # side of a patch, world units: a few pixels, so that every photo that shows one has points in it
GAP = 1  # pixels by which points of neighbouring pixels of one photo may lie apart in another at a like distance

SAME = 1e-6  # relative rounding error of the distance at which a ray ends


def surface_points(view: View, depth: np.ndarray) -> np.ndarray:
    """Return the world points [H W, 3] that the pixel centres of ``view`` show; depth: [H, W], along the axis."""
    return view.center + depth.reshape(-1, 1) * pixel_directions(view)


def visible_surface(view: View, picture: Picture) -> list[np.ndarray]:
    """Return world points [P, 3] of each object's surface that ``view`` shows, one per pixel."""
    points = surface_points(view, picture.depth)
    labels = picture.labels.ravel()
    return [points[labels == class_id] for class_id in range(1, len(picture.silhouettes) + 1)]


def well_seen(parts: list[np.ndarray], min_views: int = MIN_VIEWS) -> np.ndarray:
    """Return the points [P, 3] of ``parts`` ([P_i, 3], one per photo) whose patch ``min_views`` photos or more show."""
    points = np.concatenate(parts)
    photo = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    cells = np.floor(points / PATCH).astype(np.int64)
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    patch = patch.ravel()
    pairs = np.unique(patch * len(parts) + photo)
    views = np.bincount(pairs // len(parts), minlength=patch.max(initial=0) + 1)
    return points[views[patch] >= min_views]


def seen_part(view: View, surface: np.ndarray, silhouette: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, the pixels of ``silhouette`` whose ray meets surface that photos show, hidden or not.

    surface: [P, 3] world points of the object, from ``well_seen``. silhouette: [H, W] bool.
    """
    _, rows, columns = _landing(view, surface)
    hit = np.zeros(silhouette.shape, dtype=bool)
    hit[rows, columns] = True
    # Points of neighbouring pixels of one photo lie up to a pixel apart in another: closing fills these gaps and does
    # not move the boundary.
    return ndimage.binary_closing(np.pad(hit, GAP), np.ones((3, 3)), GAP)[GAP:-GAP, GAP:-GAP] & silhouette


@dataclass(frozen=True)
class Photo:
    """A training photo: its camera, its scene, and its depth [H, W]."""

    view: View
    scene: Scene
    depth: np.ndarray


def shown_in(photo: Photo, points: np.ndarray) -> np.ndarray:
    """Return [P] bool: which world points [P, 3] of the scene's surfaces a photo shows."""
    visible = np.zeros(len(points), dtype=bool)
    inside = _landing(photo.view, points)[0]
    hits, _ = first_hits(photo.scene, photo.view.center, points[inside] - photo.view.center)
    visible[inside] = hits.t > 1.0 - SAME
    return visible


def _landing(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the indices [M] of the ``points`` [P, 3] inside the picture, and their rows and columns."""
    local = (points - view.center) @ view.camera_to_world[:3, :3]
    front = np.flatnonzero(local[:, 2] < 0)
    depth = -local[front, 2]
    columns = np.floor(view.cx + view.focal * local[front, 0] / depth).astype(np.int64)
    rows = np.floor(view.cy - view.focal * local[front, 1] / depth).astype(np.int64)
    inside = (columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)
    return front[inside], rows[inside], columns[inside]
