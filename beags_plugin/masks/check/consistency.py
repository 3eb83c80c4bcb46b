"""Points in space that tell whether views agree on which object is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

UNSEEN = -1  # of a point in a view: outside the image, behind the camera or another surface, or unlabelled
AGREEMENT = 0.6  # share of the other views' labels that must be one class for a point to say anything
LEAST_OTHERS = 3  # other views that must see the point
LEAST_POINTS = 8  # points of an object in a view that say anything about it
MOST = 0.5  # share of an object's points that must carry another label


@dataclass(frozen=True)
class Renamed:
    """A view in which ids stand for each other's objects: ``instead`` of the key the view says the value.

    points: how many say so.
    """

    view: int
    instead: dict[int, int]
    points: int


def labels_at(
    xy: np.ndarray, z: np.ndarray, ranks: np.ndarray, depth: np.ndarray | None = None, tau: float = 0.02
) -> np.ndarray:
    """[P] int16, the label that a view gives each point, or ``UNSEEN``.

    xy: [P, 2] pixels; z: [P] depth of the points; ranks: [H, W] int16 classes, ``UNSEEN`` where unlabelled.
    depth: [H, W] of the surface, or None; a point counts then only if |z - D| <= tau z.
    """
    height, width = ranks.shape
    with np.errstate(invalid="ignore"):
        inside = (z > 0) & (xy[:, 0] >= 0) & (xy[:, 0] < width) & (xy[:, 1] >= 0) & (xy[:, 1] < height)
    found = np.full(len(z), UNSEEN, np.int16)
    index = np.flatnonzero(inside)
    column, row = xy[index].astype(np.int64).T
    if depth is not None:
        visible = np.abs(z[index] - depth[row, column]) <= tau * z[index]
        index, column, row = index[visible], column[visible], row[visible]
    found[index] = ranks[row, column]
    return found


class Agreement:
    """What all views say of P points, and what each view says against the others.

    labels: [P, V] int16 ranks below ``classes``, or ``UNSEEN``; see ``labels_at``. Rank 0 is the background.
    """

    def __init__(self, labels: np.ndarray, classes: int) -> None:
        self.labels, self.classes = labels, classes
        points, views = labels.shape
        self.votes = np.zeros((points, classes), np.int32)
        for view in range(views):
            seen = np.flatnonzero(labels[:, view] != UNSEEN)
            self.votes[seen, labels[seen, view]] += 1
        self.confusion = np.stack([self._against_others(view) for view in range(views)])
        """[V, C, C]: points of which the others say the row's class and the view the column's."""

    def _against_others(self, view: int) -> np.ndarray:
        own = self.labels[:, view]
        seen = np.flatnonzero(own != UNSEEN)
        others = self.votes[seen].copy()
        others[np.arange(len(seen)), own[seen]] -= 1
        winner, total = others.argmax(1), others.sum(1)
        clear = (total >= LEAST_OTHERS) & (others.max(1, initial=0) >= AGREEMENT * total)
        pairs = winner[clear] * self.classes + own[seen][clear]
        return np.bincount(pairs, minlength=self.classes**2).reshape(self.classes, self.classes)

    def renamed(self) -> list[Renamed]:
        """Views in which ids are exchanged (the background's with an object's: the mask is inverted), or one is new."""
        return [found for view in range(len(self.confusion)) for found in self._renamed(view)]

    def _renamed(self, view: int) -> list[Renamed]:
        confusion = self.confusion[view]
        points = confusion.sum(1)
        said = {
            int(rank): int(confusion[rank].argmax())
            for rank in np.flatnonzero(points >= LEAST_POINTS)
            if confusion[rank].max() >= MOST * points[rank]
        }
        exchanged: list[dict[int, int]] = []
        for start in said:
            if not any(start in pairs for pairs in exchanged):
                exchanged += self._cycle(said, start)
        shares = {rank: confusion[rank, new] / points[rank] for rank, new in said.items()}
        for new in sorted(set(said.values()) - {0}):
            # an id of which no view tells where it is: the object was called anew; what it hides has its label too
            if self.confusion[:, new].sum() < LEAST_POINTS:
                exchanged.append({max((r for r in said if said[r] == new), key=lambda rank: shares[rank]): new})
        return [Renamed(view, pairs, sum(int(confusion[pair]) for pair in pairs.items())) for pairs in exchanged]

    @staticmethod
    def _cycle(said: dict[int, int], start: int) -> list[dict[int, int]]:
        """Classes that stand for each other in a ring, as a ↔ b, beginning with ``start``; or none."""
        path = [start]
        while (following := said.get(path[-1])) is not None and following not in path:
            path.append(following)
        return [{rank: said[rank] for rank in path}] if following == start and len(path) > 1 else []


def ranks_of(labels: np.ndarray, ids: Sequence[int], ignore: int) -> np.ndarray:
    """[H, W] int16, the place of each class id among ``ids`` (sorted); ``UNSEEN`` for IGNORE and other ids."""
    table = np.full(ignore + 1, UNSEEN, np.int16)
    table[np.asarray(ids, np.int64)] = np.arange(len(ids))
    return table[labels]
