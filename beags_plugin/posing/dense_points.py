"""Dense points on the surfaces of a scene, from depths on which several photos agree."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from beags_plugin.posing.plane_sweep import PosedPhoto, SweptDepth, swept

NEIGHBOURS = 5  # photos that each photo is compared with
ANGLES = (
    4.0,
    40.0,
)  # degrees between the rays of neighbours: smaller ones give no depth, larger ones look different
USEFUL_ANGLE = 8.0  # degrees beyond which a wider angle makes no better neighbour
LEAST_SHARED = 10  # known points that both photos of a pair must show
NEARER, FARTHER = 0.6, 3.0  # factors by which depths may exceed those of the known points
OTHERS = 12  # photos in which a depth is verified, those that share most points
AGREE = 2  # photos among these that must have the same depth
WORKERS = 4  # threads at most; each takes 300 MB for a photo of 30,000 pixels
STEPS, PIXELS = 1.5, 1.5  # plane distances, and pixels in the photo, by which agreeing depths may differ


def dense_points(
    photos: Sequence[PosedPhoto],
    colors: Sequence[np.ndarray],
    points: np.ndarray,
    count: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return about ``count`` points [N, 3] float32 on surfaces and their colours [N, 3] uint8; fewer if few agree.

    Depths come from ``plane_sweep.swept``; a depth counts if ``AGREE`` other photos have the same. The points are
    evenly dense in the photos: at twice the distance they lie twice as far apart.

    colors: [H, W, 3] uint8 of each photo. points: [P, 3] known points, world. progress: receives (done, total) photos.
    """
    inside = np.array([photo.seen(points)[0] for photo in photos])
    shared = inside.astype(np.int64) @ inside.T.astype(np.int64)

    def depth_of(index: int) -> SweptDepth | None:
        photo, chosen = photos[index], _neighbours(index, photos, points, inside, shared)
        if not chosen:
            return None
        near, far = np.quantile(photo.seen(points)[2][inside[index]], (0.01, 0.99))
        return swept(photo, [photos[other] for other in chosen], NEARER * near, FARTHER * far)

    depths: list[SweptDepth | None] = []
    with ThreadPoolExecutor(min(WORKERS, os.cpu_count() or 1)) as pool:
        for depth in pool.map(depth_of, range(len(photos))):
            depths.append(depth)
            progress(len(depths), len(photos))
    places, shades, weights, distances = [], [], [], []
    for index, (photo, color) in enumerate(zip(photos, colors, strict=True)):
        place, pixels, weight = _verified(index, photos, depths, np.argsort(-shared[index], kind="stable"))
        places.append(place)
        shades.append(color[pixels])
        weights.append(weight)
        distances.append(np.linalg.norm(place - photo.center, axis=1))
    return _thinned(
        np.concatenate(places), np.concatenate(shades), np.concatenate(weights), np.concatenate(distances), count
    )


def _neighbours(
    index: int, photos: Sequence[PosedPhoto], points: np.ndarray, inside: np.ndarray, shared: np.ndarray
) -> list[int]:
    """Return the photos to compare a photo with: those that share many of ``points`` at a useful angle."""
    ranks = []
    for other in range(len(photos)):
        both = inside[index] & inside[other]
        if other == index or shared[index, other] < LEAST_SHARED:
            continue
        rays = [points[both] - photos[each].center for each in (index, other)]
        first, second = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in rays)
        angle = float(np.degrees(np.median(np.arccos((first * second).sum(axis=1).clip(-1.0, 1.0)))))
        if ANGLES[0] <= angle <= ANGLES[1]:
            ranks.append((-shared[index, other] * min(1.0, angle / USEFUL_ANGLE), other))
    return [other for _, other in sorted(ranks)[:NEIGHBOURS]]


def _verified(
    index: int, photos: Sequence[PosedPhoto], depths: Sequence[SweptDepth | None], others: np.ndarray
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], np.ndarray]:
    """Return the points [N, 3] of a photo that others confirm, their (rows, columns) and the number of others, [N]."""
    own = depths[index]
    if own is None:
        return np.zeros((0, 3)), (np.zeros(0, np.int64), np.zeros(0, np.int64)), np.zeros(0)
    rows, columns = np.nonzero(own.sure)
    xy, inverse = np.column_stack([columns, rows]) + 0.5, own.inverse[rows, columns]
    places = photos[index].lifted(xy, inverse)
    agreed, total = np.zeros(len(places), np.int64), inverse.copy()
    for other in [int(each) for each in others if each != index and depths[each] is not None][:OTHERS]:
        depth = depths[other]
        assert depth is not None
        seen, at, z = photos[other].seen(places)
        candidates = np.flatnonzero(seen)
        column, row = at[candidates].astype(np.int64).T
        theirs = depth.inverse[row, column]
        same = depth.sure[row, column] & (np.abs(theirs - 1.0 / z[candidates]) < STEPS * depth.step)
        candidates = candidates[same]
        back = photos[other].lifted(at[candidates], theirs[same])
        _, landed, own_z = photos[index].seen(back)
        close = np.linalg.norm(landed - xy[candidates], axis=1) < PIXELS
        agreed[candidates[close]] += 1
        total[candidates[close]] += 1.0 / own_z[close]
    sure = agreed >= AGREE
    mean = total[sure] / (agreed[sure] + 1)
    return photos[index].lifted(xy[sure], mean), (rows[sure], columns[sure]), agreed[sure].astype(np.float64)


def _thinned(
    places: np.ndarray, colors: np.ndarray, weights: np.ndarray, distances: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``count`` weighted means of the points in cells that grow with the distance from a camera.

    Cells with a single point are dropped: several photos should have put points there.
    """
    octave = np.floor(np.log2(np.maximum(distances, 1e-9))).astype(np.int64)

    def cells(size: float) -> tuple[np.ndarray, np.ndarray]:
        key = np.column_stack([octave, np.floor(places / (size * 2.0**octave)[:, None]).astype(np.int64)])
        _, cell, members = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        return cell.ravel(), members

    small, large = 1e-5, 1.0
    for _ in range(14):
        size = float(np.sqrt(small * large))
        if (cells(size)[1] > 1).sum() > count:
            small = size
        else:
            large = size
    cell, members = cells(large)
    total = np.bincount(cell, weights, len(members))

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(cell, weights * values[:, axis], len(members)) for axis in range(3)]
        return (np.column_stack(sums) / total[:, None])[members > 1]

    return mean(places).astype(np.float32), np.rint(mean(colors.astype(np.float64))).astype(np.uint8)
