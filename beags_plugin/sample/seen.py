"""The part of an object's silhouette that rests on surface which the training photos show.

Where objects touch, photos show their surfaces nowhere or only through a gap. An evaluation may leave such pixels of
the silhouette out. Likewise what an object hid can only be put back where some photo shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from beags_plugin.sample.scene import Scene
from beags_plugin.sample.tracing import first_hits
from beags_plugin.sample.views import Picture, View, pixel_directions

MIN_VIEWS = 6  # photos that must show a patch of surface; fewer, through a gap and at a slant, do not place it in space
PATCH = 0.03  # side of a patch, world units: a few pixels, so that every photo that shows one has points in it
GAP = 1  # pixels: points of neighbouring pixels of one photo lie at most so far apart in another, seen at like distance

NEAR = 0.05  # share of a point's depth by which that of its pixel in a photo may differ where it is not hidden
SAME = 1e-6  # share of the distance to a point by which rounding lets a ray end before it


def surface_points(view: View, depth: np.ndarray) -> np.ndarray:
    """Return the world points [H W, 3] that the pixel centres of ``view`` show; depth: [H, W], along the axis."""
    return view.center + depth.reshape(-1, 1) * pixel_directions(view)


def visible_surface(view: View, picture: Picture) -> list[np.ndarray]:
    """Return world points [P, 3] of each object's surface that ``view`` shows, one per pixel."""
    points = surface_points(view, picture.depth)
    labels = picture.labels.ravel()
    return [points[labels == class_id] for class_id in range(1, len(picture.silhouettes) + 1)]


def well_seen(parts: list[np.ndarray], min_views: int = MIN_VIEWS) -> np.ndarray:
    """Return points [P, 3] of ``parts`` ([P_i, 3], one per photo) whose patch at least ``min_views`` photos show."""
    points = np.concatenate(parts)
    photo = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
    cells = np.floor(points / PATCH).astype(np.int64)
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    patch = patch.ravel()
    pairs = np.unique(patch * len(parts) + photo)
    views = np.bincount(pairs // len(parts), minlength=patch.max(initial=0) + 1)
    return points[views[patch] >= min_views]


def seen_part(view: View, surface: np.ndarray, silhouette: np.ndarray) -> np.ndarray:
    """Return [H, W] bool, the pixels of ``silhouette`` whose ray meets the object's seen surface, near or far.

    surface: [P, 3] world points of the object, as ``well_seen`` gives them. silhouette: [H, W] bool.
    """
    _, rows, columns, _ = _landing(view, surface)
    hit = np.zeros(silhouette.shape, dtype=bool)
    hit[rows, columns] = True
    # Points of neighbouring pixels of one photo lie up to a pixel apart in another: closing fills the gaps between
    # them and leaves the boundary where it is.
    return ndimage.binary_closing(np.pad(hit, GAP), np.ones((3, 3)), GAP)[GAP:-GAP, GAP:-GAP] & silhouette


@dataclass(frozen=True)
class Photo:
    """A photo of training: its camera, what stood before it, and its depth [H, W]."""

    view: View
    scene: Scene
    depth: np.ndarray


def shown_in(photo: Photo, points: np.ndarray) -> np.ndarray:
    """Return [P] bool: which world points [P, 3] of the scene's surfaces a photo shows."""
    shown = np.zeros(len(points), dtype=bool)
    inside = _landing(photo.view, points)[0]
    shown[inside] = _reached(photo, points[inside])
    return shown


def shown_points(points: np.ndarray, photos: Sequence[Photo]) -> np.ndarray:
    """Return [P] bool: which world points [P, 3] of the scene's surfaces some photo shows.

    Depth tells for most points that they are hidden; rays are cast at the others.
    """
    shown = np.zeros(len(points), dtype=bool)
    for photo in photos:
        rest = np.flatnonzero(~shown)
        inside, rows, columns, depth = _landing(photo.view, points[rest])
        near = rest[inside[np.abs(depth - photo.depth[rows, columns]) <= NEAR * depth]]
        shown[near] = _reached(photo, points[near])
    return shown


def _reached(photo: Photo, points: np.ndarray) -> np.ndarray:
    """Return [P] bool: which world points [P, 3] on surfaces nothing hides from the photo's camera."""
    hits, _ = first_hits(photo.scene, photo.view.center, points - photo.view.center)
    return hits.t > 1.0 - SAME


def _landing(view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return which of ``points`` [P, 3] lie inside the picture, [M], and of these row, column and depth."""
    local = (points - view.center) @ view.camera_to_world[:3, :3]
    front = np.flatnonzero(local[:, 2] < 0)
    depth = -local[front, 2]
    columns = np.floor(view.cx + view.focal * local[front, 0] / depth).astype(np.int64)
    rows = np.floor(view.cy - view.focal * local[front, 1] / depth).astype(np.int64)
    inside = (columns >= 0) & (columns < view.width) & (rows >= 0) & (rows < view.height)
    return front[inside], rows[inside], columns[inside], depth[inside]
