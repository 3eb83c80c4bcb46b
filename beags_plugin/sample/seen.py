"""Which part of an object's silhouette rests on surface that some training photo shows.

Where an object touches another, or lies in one, no photo shows its surface. What it looks like there cannot be known, so
an evaluation may leave those pixels of the silhouette out.
"""

from __future__ import annotations

import numpy as np

from beags_plugin.sample.views import Picture, View

GAP = 1  # pixels: points of neighbouring pixels of one photo lie at most so far apart in another, seen at like distance


def visible_surface(view: View, picture: Picture) -> list[np.ndarray]:
    """World points [P, 3] of each object's surface that ``view`` shows, one per pixel."""
    rows, columns = np.indices(picture.labels.shape)
    directions = view.directions(columns.ravel() + 0.5, rows.ravel() + 0.5)
    points = view.center + picture.depth.reshape(-1, 1) * directions
    labels = picture.labels.ravel()
    return [points[labels == class_id] for class_id in range(1, len(picture.silhouettes) + 1)]


def seen_part(view: View, surface: np.ndarray, silhouette: np.ndarray) -> np.ndarray:
    """[H, W] bool, the pixels of ``silhouette`` whose ray meets the object's seen surface, on the near or far side.

    surface: [P, 3] world points of the object that training photos show. silhouette: [H, W] bool.
    """
    rotation = view.camera_to_world[:3, :3]
    local = (surface - view.center) @ rotation
    depth = -local[:, 2]
    front = depth > 0
    x = np.floor(view.cx + view.focal * local[front, 0] / depth[front]).astype(np.int64)
    y = np.floor(view.cy - view.focal * local[front, 1] / depth[front]).astype(np.int64)
    height, width = silhouette.shape
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    hit = np.zeros((height + 2 * GAP, width + 2 * GAP), dtype=bool)
    hit[y[inside] + GAP, x[inside] + GAP] = True
    steps = range(2 * GAP + 1)
    grown = np.logical_or.reduce([hit[i : i + height, j : j + width] for i in steps for j in steps])
    return grown & silhouette
