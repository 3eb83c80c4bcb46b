"""Depths of photos with poses by a plane sweep: each photo is compared with its neighbours at many depths.

The cost of a depth is one minus the normalised correlation of small windows, which is independent of exposure. Costs
are smoothed along rows and columns as in semi-global matching (Hirschmueller, PAMI 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

PLANES = 96  # depths, evenly spaced in inverse depth
WINDOW = (7, 7)  # pixels that are correlated
LEAST_CORRELATION = 0.5  # correlation with the neighbours below which a depth is not sure
LEAST_MARGIN = 0.02  # cost by which all other depths must exceed the best one
LEAST_VARIANCE = 1e-5  # variance of grey, in 0..1, below which a window matches any other plain one
SMALL_CHANGE, LARGE_CHANGE = 0.1, 0.6  # costs of a depth that changes by one plane, or more, from pixel to pixel
AT_EDGES = 20.0  # a large change costs less where the photo changes too: 1 + this times the change of grey
_UNSEEN = 1.2  # cost of a depth at which no neighbour shows the pixel, more than that of no correlation
_INVERSE = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
_WORST = -0.2  # least correlation; smaller ones count as this


@dataclass(frozen=True)
class PosedPhoto:
    """A photo with its camera.

    grey: [H, W] float32 in 0..1. K: [3, 3] float64, pixels, whose centres lie at + 0.5. pose: [4, 4] float64, world to
    camera, OpenCV axes.
    """

    grey: np.ndarray
    K: np.ndarray
    pose: np.ndarray

    @property
    def center(self) -> np.ndarray:
        """Return the camera's position in the world, [3]."""
        return -self.pose[:3, :3].T @ self.pose[:3, 3]

    def seen(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which points [P, 3] lie in the picture, [P] bool, their pixels [P, 2] and depths [P]."""
        local = points @ self.pose[:3, :3].T + self.pose[:3, 3]
        z = local[:, 2]
        projected = local @ self.K.T
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = projected[:, :2] / projected[:, 2:]
        height, width = self.grey.shape
        return (z > 0) & ((xy >= 0) & (xy < [width, height])).all(axis=1), xy, z

    def lifted(self, xy: np.ndarray, inverse: np.ndarray) -> np.ndarray:
        """Return the points [P, 3] float64 at pixels [P, 2] and inverse depths [P]."""
        rays = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(self.K).T
        return (rays / inverse[:, None] - self.pose[:3, 3]) @ self.pose[:3, :3]


@dataclass(frozen=True)
class SweptDepth:
    """inverse: [H, W] float64, 1 / depth along the axis. sure: [H, W] bool. step: inverse depth between planes."""

    inverse: np.ndarray
    sure: np.ndarray
    step: float


def swept(photo: PosedPhoto, neighbours: Sequence[PosedPhoto], nearest: float, farthest: float) -> SweptDepth:
    """Return the depths between ``nearest`` and ``farthest``, world units, at which the neighbours agree best."""
    planes = np.linspace(1.0 / farthest, 1.0 / nearest, PLANES)
    means, variances = _window(photo.grey)
    costs = np.stack([_costs(photo, other, planes, means, variances) for other in neighbours])
    cost = _of_best_half(costs)
    smooth = _smoothed(cost, photo.grey)
    best = smooth.argmin(axis=0).clip(1, PLANES - 2)
    before, here, after = (np.take_along_axis(smooth, (best + move)[None], 0)[0] for move in (-1, 0, 1))
    bend = before - 2.0 * here + after
    between = np.where(bend > 1e-6, 0.5 * (before - after) / np.maximum(bend, 1e-6), 0.0).clip(-0.5, 0.5)
    other = np.abs(np.arange(PLANES)[:, None, None] - best) > 3
    margin = np.where(other, smooth, np.inf).min(axis=0) - here
    step = float(planes[1] - planes[0])
    sure = np.take_along_axis(cost, best[None], 0)[0] < 1.0 - LEAST_CORRELATION
    sure &= (margin > LEAST_MARGIN) & (variances > LEAST_VARIANCE)
    return SweptDepth(planes[0] + (best + between.astype(np.float64)) * step, sure, step)


def _window(grey: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean and the variance of the window about each pixel."""
    mean = cv2.boxFilter(grey, -1, WINDOW)
    return mean, cv2.boxFilter(grey * grey, -1, WINDOW) - mean * mean


def _costs(
    photo: PosedPhoto, other: PosedPhoto, planes: np.ndarray, means: np.ndarray, variances: np.ndarray
) -> np.ndarray:
    """Return 1 - correlation [D, H, W] float32 with another photo at each plane; nan outside of the other photo."""
    relative = other.pose @ np.linalg.inv(photo.pose)
    centres = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    to_rays, to_pixels = np.linalg.inv(photo.K) @ centres, np.linalg.inv(centres) @ other.K
    costs = np.empty((len(planes), *photo.grey.shape), np.float32)
    for plane, inverse in enumerate(planes):
        map_to = to_pixels @ (relative[:3, :3] + np.outer(relative[:3, 3], [0.0, 0.0, inverse])) @ to_rays
        moved = cv2.warpPerspective(other.grey, map_to, photo.grey.shape[::-1], flags=_INVERSE, borderValue=(-1.0,))
        outside = moved < -1e-3
        moved[outside] = 0.0
        mean, variance = _window(moved)
        product = cv2.boxFilter(np.multiply(moved, photo.grey), -1, WINDOW) - mean * means
        correlation = product / np.sqrt(np.maximum(variance, LEAST_VARIANCE) * np.maximum(variances, LEAST_VARIANCE))
        correlation[outside] = np.nan
        costs[plane] = 1.0 - np.clip(correlation, _WORST, 1.0)
    return costs


def _of_best_half(costs: np.ndarray) -> np.ndarray:
    """Return the mean cost [D, H, W] of the better half of the neighbours [N, D, H, W] that show a pixel.

    The other half may see something in front of the surface.
    """
    seen = np.isfinite(costs).sum(axis=0)
    ranked = np.sort(np.where(np.isfinite(costs), costs, np.float32(9.0)), axis=0).cumsum(axis=0)
    half = np.maximum((seen + 1) // 2, 1)
    return np.where(seen > 0, np.take_along_axis(ranked, (half - 1)[None], 0)[0] / half, _UNSEEN).astype(np.float32)


def _smoothed(cost: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Return the mean of the costs [D, H, W] accumulated from the left, the right, above and below."""
    rows = np.ascontiguousarray(cost.transpose(1, 2, 0))  # [lines, pixels along them, D]
    columns = np.ascontiguousarray(cost.transpose(2, 1, 0))
    along_rows = _both_ways(rows, np.abs(np.diff(grey, axis=1, prepend=grey[:, :1])))
    along_columns = _both_ways(columns, np.abs(np.diff(grey, axis=0, prepend=grey[:1])).T)
    return (along_rows + along_columns.transpose(1, 0, 2)).transpose(2, 0, 1) / 4.0


def _both_ways(cost: np.ndarray, change: np.ndarray) -> np.ndarray:
    return _gathered(cost, change) + _gathered(cost[:, ::-1], np.roll(change, -1, axis=1)[:, ::-1])[:, ::-1]


def _gathered(cost: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Return costs [lines, pixels, D] plus the least cost of a path through the earlier pixels of the line.

    change: [lines, pixels], difference in grey from the pixel before.
    """
    large = np.maximum(LARGE_CHANGE / (1.0 + AT_EDGES * change), SMALL_CHANGE).astype(np.float32)
    gathered = np.empty_like(cost)
    gathered[:, 0] = before = cost[:, 0]
    for pixel in range(1, cost.shape[1]):
        least = before.min(axis=1, keepdims=True)
        way = np.minimum(before, least + large[:, pixel, None])
        np.minimum(way[:, 1:], before[:, :-1] + np.float32(SMALL_CHANGE), out=way[:, 1:])
        np.minimum(way[:, :-1], before[:, 1:] + np.float32(SMALL_CHANGE), out=way[:, :-1])
        gathered[:, pixel] = before = cost[:, pixel] + way - least
    return gathered
