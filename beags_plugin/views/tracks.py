"""Tracks: the points of a structure-from-motion model that each view saw, and their places in its photo."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beags_plugin.data.dataset import Dataset
from beags_plugin.data.layouts.colmap import complete_model
from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_json, reason
from beags_plugin.views.colmap_files import read_features
from beags_plugin.views.lens import project_through_lens
from beags_plugin.views.poses import PosedViews

Tracks = list[tuple[np.ndarray, np.ndarray]]
"""For each view, ids [N] of the points that it saw, -1 for none, and places [N, 2] in 0..1; empty if unknown."""

SEED_TRACKS = "seed_tracks.json"
"""File of a scene with the photos that show each seed point: {"photos": [stems], "points": [[indices], ...]}."""


def seeds_seen(root: Path, points: np.ndarray, views: PosedViews) -> Tracks:
    """Return the seed points that each view shows, from ``SEED_TRACKS`` of the scene; empty without the file.

    points: [P, 3] float64 in the cameras' world. Raises ``UserError`` for a file that does not fit the points.
    """
    file = root / SEED_TRACKS
    if not file.is_file():
        return []
    try:
        content = load_json(file)
        photos, seen = [str(stem) for stem in content["photos"]], content["points"]
        pairs = [(photos[photo], point) for point, shown in enumerate(seen) for photo in shown]
        if any(photo < 0 for shown in seen for photo in shown):
            raise ValueError("an index of a photo is negative")
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise UserError(f"{file} cannot be read ({reason(error)}): write it anew, or delete it.") from error
    if len(seen) != len(points):
        raise UserError(f"{file} lists {len(seen)} seed points, but there are {len(points)}: delete it.")
    of_photo: dict[str, list[int]] = {}
    for stem, point in pairs:
        of_photo.setdefault(stem, []).append(point)
    tracks = []
    for view, stems in enumerate(views.stems):
        ids = np.array(next((of_photo[stem] for stem in stems if stem in of_photo), []), np.int64)
        xy, z = project_through_lens(points[ids], views.cameras, view)
        size = int(views.cameras.width[view]), int(views.cameras.height[view])
        tracks.append((np.where(z > 0, ids, -1), np.where(z[:, None] > 0, xy / size, 0.0)))
    return tracks


def features_of(scene: Dataset, views: PosedViews) -> Tracks:
    """Return the features of each view in the COLMAP model of a scene, with the ids of their points; empty without.

    The poses may come from another file beside the model.
    """
    folder = complete_model(scene.root)
    if folder is None:
        return []
    named: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for name, features in read_features(folder).items():
        for key in {name, name.rpartition("/")[2]}:
            named.setdefault(key, []).append(features)
    none = np.zeros(0, np.int64), np.zeros((0, 2))
    tracks = []
    for stems in views.stems:
        alone = [named[stem][0] for stem in sorted(stems, key=len) if len(named.get(stem, ())) == 1]
        tracks.append(alone[-1] if alone else none)
    return tracks
