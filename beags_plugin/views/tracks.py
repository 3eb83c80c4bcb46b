"""Which points of a structure-from-motion model each view has seen, and where in its photo."""

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
"""Points that each view saw: ids [N], -1 for no point, and places [N, 2] in 0..1; empty where nothing tells."""

SEED_TRACKS = "seed_tracks.json"
"""File of a scene that says which photos show its seed points: {"photos": [stems], "points": [[indices], ...]}."""


def seeds_seen(root: Path, points: np.ndarray, views: PosedViews) -> Tracks:
    """Return which seed points each view shows, by ``SEED_TRACKS`` of the scene; empty without the file.

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
        raise UserError(f"{file} tells of {len(seen)} seed points, but there are {len(points)}: delete it.")
    of_photo: dict[str, list[int]] = {}
    for stem, point in pairs:
        of_photo.setdefault(stem, []).append(point)
    found = []
    for view, stems in enumerate(views.stems):
        ids = np.array(next((of_photo[stem] for stem in stems if stem in of_photo), []), np.int64)
        xy, z = project_through_lens(points[ids], views.cameras, view)
        size = int(views.cameras.width[view]), int(views.cameras.height[view])
        found.append((np.where(z > 0, ids, -1), np.where(z[:, None] > 0, xy / size, 0.0)))
    return found


def features_of(scene: Dataset, views: PosedViews) -> Tracks:
    """Return the features of each view in the COLMAP model of a scene, which may lie beside poses in another file.

    Each with the id of its point, -1 where it has none, and its place.
    """
    folder = complete_model(scene.root)
    if folder is None:
        return []
    named: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {}
    for name, features in read_features(folder).items():
        for key in {name, name.rpartition("/")[2]}:
            named.setdefault(key, []).append(features)
    none = np.zeros(0, np.int64), np.zeros((0, 2))
    found = []
    for stems in views.stems:
        alone = [named[stem][0] for stem in sorted(stems, key=len) if len(named.get(stem, ())) == 1]
        found.append(alone[-1] if alone else none)
    return found
