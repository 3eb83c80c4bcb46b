"""Labels of points in all views of a scene: of points in space, and of points tracked by a COLMAP model."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beags_plugin.data.dataset import Dataset
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.check.consistency import Agreement, labels_around, labels_at, ranks_of
from beags_plugin.masks.check.contradictions import LEAST_OTHERS
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import Issue, percent
from beags_plugin.pictures.masks import Pointed
from beags_plugin.posing.turned import seem_turned, shares_explained
from beags_plugin.system.progress import progress_bar
from beags_plugin.views.cameras import camera_from_nerfstudio
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.lens import project_through_lens
from beags_plugin.views.poses import PosedViews
from beags_plugin.views.seed_points import random_points, starting_points
from beags_plugin.views.tracks import Tracks

RANDOM_POINTS = 50_000  # random points, for objects without seed points
MOST_SEED_POINTS = 100_000
MOST_COUNTS = 30_000_000  # most points times classes, or times views, in memory


def points_in_space(scene: Dataset, views: PosedViews, config: DataOptions) -> np.ndarray:
    """Return [P, 3] float64 in the cameras' world: seed points, and random points where the cameras look."""
    seeds = starting_points(scene, views, config.num_random_points)["points3D_xyz"].double().numpy()
    step = -(-len(seeds) // MOST_SEED_POINTS)
    cameras = [camera_from_nerfstudio(views.cameras, index) for index in range(len(views.images))]
    random, _ = random_points(cameras, RANDOM_POINTS)
    return np.concatenate([seeds[::step], random.astype(np.float64)])


def tracks_of(features: Tracks, classes: int) -> Tracks:
    """Return the features of each view that have a point, with the point's row in a table instead of its id.

    Points are thinned so that the table has at most ``MOST_COUNTS`` entries. classes: their number.
    """
    ids = np.unique(np.concatenate([points[points >= 0] for points, _ in features] or [np.zeros(0, np.int64)]))
    ids = ids[:: max(1, -(-len(ids) * max(classes, len(features)) // MOST_COUNTS))]
    known = [np.isin(points, ids) for points, _ in features]
    return [(np.searchsorted(ids, points[k]), places[k]) for (points, places), k in zip(features, known, strict=True)]


def turned(features: Tracks, files: MaskFiles, coverage: Coverage) -> Issue | None:
    """Return an issue if the objects seem to have turned while the room, from which the poses come, stayed."""

    def photos() -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        for view in np.flatnonzero(coverage.usable).tolist():
            ids, places = features[view]
            if len(ids) and (mask := files.read(view)) is not None:
                yield places, ids >= 0, mask

    if not any((ids < 0).any() for ids, _ in features):  # the model stores only features with points
        return None
    inside, around, count = shares_explained(photos())
    if not seem_turned(inside, around, count):
        return None
    return Issue(
        "warning",
        "turned",
        f"the poses explain {percent(inside, 1)} of the features on objects, and {percent(around, 1)} of those around "
        "them: if the objects turned while the room stood, find their own poses with beags process --masks.",
        "objects that turned come out as a blur; what is plain or shiny has few good features anyway",
    )


def agreements(
    files: MaskFiles, coverage: Coverage, views: PosedViews, points: np.ndarray, tracks: Tracks
) -> tuple[Agreement, Agreement]:
    """Return the agreement at points in space, and at those of ``tracks`` in the views that saw them."""
    classes = len(coverage.ids)
    points = points[:: -(-len(points) * classes // MOST_COUNTS)]
    labels = np.full((len(points), len(files.stems)), -1, np.int16)
    rows = 1 + max((rows.max(initial=-1) for rows, _ in tracks), default=-1)
    tracked = np.full((rows, len(files.stems)), -1, np.int16)
    with progress_bar("Comparing views") as progress:
        for view in range(len(files.stems)):
            if coverage.usable[view]:
                mask = files.read(view)
                assert mask is not None
                ranks = ranks_of(mask, coverage.ids, IGNORE)
                xy, z = project_through_lens(points, views.cameras, view)
                labels[:, view] = labels_at(xy, z, ranks)
                if tracks:
                    rows, places = tracks[view]
                    tracked[rows, view] = labels_around(places * ranks.shape[::-1], ranks)
            progress(view + 1, len(files.stems))
    return Agreement(labels, classes), Agreement(tracked, classes, LEAST_OTHERS)


def pointed(files: MaskFiles, views: PosedViews, view: int, tracks: Tracks, seen: Agreement, ids: list[int]) -> Pointed:
    """Return a view with the points that the other views label differently."""
    points, others = seen.against_others(view)
    wrong = others != seen.labels[points, view]
    places = dict(zip(tracks[view][0].tolist(), tracks[view][1], strict=True))
    xy = np.array([places[point] for point in points[wrong].tolist()])
    mask = files.read(view)
    assert mask is not None
    return Pointed(files.stems[view], views.images[view], mask, xy, np.asarray(ids)[others[wrong]])
