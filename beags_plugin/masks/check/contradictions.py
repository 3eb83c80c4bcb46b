"""Views and areas of masks that the other views contradict, the worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.check.consistency import Agreement, band
from beags_plugin.masks.check.issues import Issue, named, percent
from beags_plugin.system.wording import amount, verb

LEAST_OTHERS = 2  # least other views that see a point of a track; most tracks are short
LEAST = 4  # least contradicted points of an object in a view
SHARE = {"points": 0.02, "pixels": 0.05}  # least contradicted share; pixels rely on depths, which are less exact
WORST = 0.5  # score, as a share of the worst one, from which on views are silenced together
SMALLEST = 0.0005  # least size of an area, as a share of the image
CONFIDENCE = 0.6  # least share of the votes that contradict a pixel of an area


@dataclass(frozen=True)
class Contradiction:
    """An object in a view whose mask leaves out ``missing`` points or pixels (``of``) and takes in ``extra`` ones.

    total: points or pixels that the view or the others give to the object.
    """

    view: str
    class_id: int
    missing: int
    extra: int
    total: int
    of: Literal["points", "pixels"]

    @property
    def score(self) -> float:
        """Return the contradicted share, shrunk towards 0 where the total is small."""
        return (self.missing + self.extra) / (self.total + LEAST)

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "score": round(self.score, 4)}

    def __str__(self) -> str:
        errors = (("leaves out", self.missing), ("takes in", self.extra))
        shares = " and ".join(f"{verb} {percent(part, self.total)}" for verb, part in errors if part)
        return f"{self.view} {shares} of {self.total} {self.of}"


def contradictions(
    right: np.ndarray,
    missing: np.ndarray,
    extra: np.ndarray,
    views: Sequence[str],
    ids: Sequence[int],
    of: Literal["points", "pixels"],
) -> list[Contradiction]:
    """Find views and objects that the other views contradict.

    right: [V, C], points or pixels that both a view and the others give to a class. missing, extra: [V, C], those that
    only the others, or only the view, give to it.
    """
    wrong, total = missing + extra, missing + extra + right
    disputed = [
        Contradiction(views[v], ids[k], int(missing[v, k]), int(extra[v, k]), int(total[v, k]), of)
        for v, k in [(int(v), int(k)) for v, k in np.argwhere((wrong >= LEAST) & (wrong >= SHARE[of] * total))]
        if ids[k] != BACKGROUND
    ]
    return sorted(disputed, key=lambda one: -one.score)


def settle(agreement: Agreement, views: Sequence[str], ids: Sequence[int]) -> list[Contradiction]:
    """Find contradictions at tracked points, and take the votes of the worst views away until the others agree.

    A bad view that still voted would make good views look wrong.
    """
    while True:
        right = np.einsum("vcc->vc", agreement.confusion)
        missing, extra = (agreement.confusion.sum(axis) - right for axis in (2, 1))
        disputed = contradictions(right, missing, extra, views, ids, "points")
        scores = {views.index(one.view): one.score for one in reversed(disputed)}  # worst score of each view
        scores = {view: score for view, score in scores.items() if agreement.voting[view]}
        if not scores:
            return disputed
        agreement.silence([view for view, score in scores.items() if score >= WORST * max(scores.values())])


def issues_of(found: Sequence[Contradiction], names: Mapping[int, str], masks: int) -> list[Issue]:
    """Return an issue for each object. found: of one kind, the worst first. masks: number of all masks."""
    issues = []
    for class_id in dict.fromkeys(one.class_id for one in found):
        of = [one for one in found if one.class_id == class_id]
        wrong, total = sum(one.missing + one.extra for one in of), sum(one.total for one in of)
        if of[0].of == "points":
            witnesses = "the labels of points that several views saw"
            cost = f"{percent(wrong, total)} of its points in these views vote for the wrong class"
        else:
            witnesses = "the other views at the run's depths"
            cost = f"{wrong} pixels ({percent(wrong, total)} of it in these views) go to another class in reprojection"
        message = (
            f"{len(of)} of {amount(masks, 'mask')} of {class_id} ({names[class_id]}) {verb(len(of), 'contradict')} "
            f"{witnesses}, worst first: "
            f"{named(of)}; correct them where contradicted.png shows it, or remove them (a view without a mask does "
            "not vote)."
        )
        remedy = "reprojection outvotes single views, but not many; without it they pull Gaussians to the wrong class"
        views = tuple(one.view for one in of)
        issues.append(Issue("warning", "contradicted", message, f"{cost}; {remedy}", views, (class_id,)))
    return issues


@dataclass(frozen=True)
class Area:
    """A connected area of class ``given`` in a view's mask that the other views label ``voted``.

    share: of the image. box: left, top, right and bottom, pixels of the compared mask.
    """

    view: str
    given: int
    voted: int
    pixels: int
    share: float
    box: tuple[int, int, int, int]

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "box": list(self.box)}


def contradicted(given: np.ndarray, voted: np.ndarray, confidence: np.ndarray, view: str) -> list[Area]:
    """Find the contradicted areas of a view that are wider than the band around outlines, the largest first.

    given, voted: [H, W] class ids or IGNORE, before and after reprojection. confidence: [H, W] in 0..1.
    """
    import cv2

    height, width = given.shape
    wrong = (given != voted) & (given != IGNORE) & (voted != IGNORE) & (confidence >= CONFIDENCE)
    radius = band(height, width)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    core = cv2.morphologyEx(wrong.astype(np.uint8), cv2.MORPH_OPEN, disc)
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    areas = []
    for piece in range(1, count):
        left, top, wide, high, pixels = (int(value) for value in stats[piece])
        if pixels < SMALLEST * height * width:
            continue
        inside = pieces == piece
        ids = [int(np.bincount(labels[inside].astype(np.int64)).argmax()) for labels in (given, voted)]
        box = (left, top, left + wide, top + high)
        areas.append(Area(view, ids[0], ids[1], pixels, pixels / (height * width), box))
    return sorted(areas, key=lambda area: -area.pixels)
