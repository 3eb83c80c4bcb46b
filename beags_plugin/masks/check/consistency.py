"""Agreement of views on the classes of points in space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BAND = 0.003  # width of the band around outlines, over the image diagonal
UNSEEN = -1  # label of a point outside the image, behind the camera, not seen by the view, or unlabelled
AGREEMENT = 0.6  # least share that one class must have among the other views' labels of a point that counts
LEAST_OTHERS = 3  # least other views that must see a point that counts
LEAST_POINTS = 8  # least points of an object in a view
MOST = 0.5  # least share of an object's points that have one other label


@dataclass(frozen=True)
class Renamed:
    """A view with exchanged ids: ``instead`` maps the right rank to the view's, at ``points`` points in all."""

    view: int
    instead: dict[int, int]
    points: int


def labels_at(xy: np.ndarray, z: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """Return the label of each point in a view, [P] int16, or ``UNSEEN``.

    xy: [P, 2] pixels; z: [P] depth of the points; ranks: [H, W] int16 classes, ``UNSEEN`` if unlabelled.
    """
    height, width = ranks.shape
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (xy[:, 0] >= 0) & (xy[:, 0] < width) & (xy[:, 1] >= 0) & (xy[:, 1] < height)
    labels = np.full(len(z), UNSEEN, np.int16)
    column, row = xy[inside].astype(np.int64).T
    labels[inside] = ranks[row, column]
    return labels


def labels_around(xy: np.ndarray, ranks: np.ndarray) -> np.ndarray:
    """Return the label of each point that a view saw, as ``labels_at``; ``UNSEEN`` in the band around outlines."""
    ahead = np.ones(len(xy))
    labels = labels_at(xy, ahead, ranks)
    for angle in np.arange(8) * np.pi / 4:
        beside = xy + band(*ranks.shape) * np.array([np.cos(angle), np.sin(angle)])
        labels[labels_at(beside, ahead, ranks) != labels] = UNSEEN
    return labels


def band(height: int, width: int) -> int:
    """Return the width, in pixels, of the band around outlines in which any two masks differ."""
    return max(1, round(BAND * math.hypot(height, width)))


class Agreement:
    """Labels of P points in all views, and the confusion of each view with the others.

    labels: [P, V] int16 ranks below ``classes``, or ``UNSEEN``; see ``labels_at``. Rank 0 is the background.
    least: least other views that must see a point that counts.
    """

    def __init__(self, labels: np.ndarray, classes: int, least: int = LEAST_OTHERS) -> None:
        self.labels, self.classes, self.least = labels, classes, least
        points, views = labels.shape
        self.votes = np.zeros((points, classes), np.int32)
        self.voting = np.ones(views, bool)
        for view in range(views):
            seen = np.flatnonzero(labels[:, view] != UNSEEN)
            self.votes[seen, labels[seen, view]] += 1
        self._compare()

    def silence(self, views: Sequence[int]) -> None:
        """Take the votes of some views away; they are still compared with the others."""
        for view in views:
            seen = np.flatnonzero(self.labels[:, view] != UNSEEN)
            self.votes[seen, self.labels[seen, view]] -= 1
        self.voting[views] = False
        self._compare()

    def against_others(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the points [N] of a view that count, and their classes [N] in the other views."""
        seen = np.flatnonzero(self.labels[:, view] != UNSEEN)
        others = self.votes[seen].copy()
        others[np.arange(len(seen)), self.labels[seen, view]] -= self.voting[view]
        total = others.sum(1)
        clear = (total >= self.least) & (others.max(1, initial=0) >= AGREEMENT * total)
        return seen[clear], others.argmax(1)[clear]

    def _compare(self) -> None:
        self.confusion = np.stack([self._confusion(view) for view in range(len(self.voting))])
        """Number of points with the row's class in the other views and the column's in the view, [V, C, C]."""

    def _confusion(self, view: int) -> np.ndarray:
        points, winner = self.against_others(view)
        pairs = winner * self.classes + self.labels[points, view]
        return np.bincount(pairs, minlength=self.classes**2).reshape(self.classes, self.classes)

    def renamed(self) -> list[Renamed]:
        """Find views with exchanged ids (an exchange with the background inverts the mask), or with a new id."""
        return [renamed for view in range(len(self.confusion)) for renamed in self._renamed(view)]

    def _renamed(self, view: int) -> list[Renamed]:
        confusion = self.confusion[view]
        points = confusion.sum(1)
        given = {
            int(rank): int(confusion[rank].argmax())
            for rank in np.flatnonzero(points >= LEAST_POINTS)
            if confusion[rank].max() >= MOST * points[rank]
        }
        exchanged: list[dict[int, int]] = []
        for start in given:
            if not any(start in pairs for pairs in exchanged):
                exchanged += self._cycle(given, start)
        shares = {rank: confusion[rank, new] / points[rank] for rank, new in given.items()}
        for new in sorted(set(given.values()) - {0}):
            # No other view has this id, so the object, and what it hides, has a new one in this view.
            if self.confusion[:, new].sum() < LEAST_POINTS:
                exchanged.append({max((r for r in given if given[r] == new), key=lambda rank: shares[rank]): new})
        return [Renamed(view, pairs, sum(int(confusion[pair]) for pair in pairs.items())) for pairs in exchanged]

    @staticmethod
    def _cycle(given: dict[int, int], start: int) -> list[dict[int, int]]:
        """Return the cycle of exchanged classes, such as a ↔ b, that begins with ``start``; empty without one."""
        path = [start]
        while (following := given.get(path[-1])) is not None and following not in path:
            path.append(following)
        return [{rank: given[rank] for rank in path}] if following == start and len(path) > 1 else []


def ranks_of(labels: np.ndarray, ids: Sequence[int], ignore: int) -> np.ndarray:
    """Return the index of each class id in the sorted ``ids``, [H, W] int16; ``UNSEEN`` for IGNORE and other ids."""
    table = np.full(ignore + 1, UNSEEN, np.int16)
    table[np.asarray(ids, np.int64)] = np.arange(len(ids))
    return table[labels]
