"""Views whose mask of an object the other views contradict, the worst first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.masks.check.consistency import Agreement
from beags_plugin.masks.check.issues import Issue, named, percent

LEAST_OTHERS = 2  # other views that see a point of a track; most tracks are short
LEAST = 4  # contradicted points of an object in a view
SHARE = {"points": 0.02, "pixels": 0.05}  # of its points, or, at depths that are less exact, of its pixels
WORST = 0.5  # of the worst score: views that are silenced together


@dataclass(frozen=True)
class Contradiction:
    """An object in a view: it leaves out ``missing`` of what the others show of the object, and takes in ``extra``.

    total: points or pixels (``of``) that the view or the others call the object.
    """

    view: str
    class_id: int
    missing: int
    extra: int
    total: int
    of: Literal["points", "pixels"]

    @property
    def score(self) -> float:
        """Return the contradicted share, nearer to 0 the fewer there are."""
        return (self.missing + self.extra) / (self.total + LEAST)

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "score": round(self.score, 4)}

    def __str__(self) -> str:
        said = (("leaves out", self.missing), ("takes in", self.extra))
        shares = " and ".join(f"{verb} {percent(part, self.total)}" for verb, part in said if part)
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

    right: [V, C] points or pixels that a view and the others give to a class. missing, extra: [V, C], that the others
    or the view alone give to it.
    """
    wrong, total = missing + extra, missing + extra + right
    found = [
        Contradiction(views[v], ids[k], int(missing[v, k]), int(extra[v, k]), int(total[v, k]), of)
        for v, k in [(int(v), int(k)) for v, k in np.argwhere((wrong >= LEAST) & (wrong >= SHARE[of] * total))]
        if ids[k] != BACKGROUND
    ]
    return sorted(found, key=lambda one: -one.score)


def settle(agreement: Agreement, views: Sequence[str], ids: Sequence[int]) -> list[Contradiction]:
    """Find contradictions at the points that views saw; views found bad lose their votes, so that none blames others.

    Ends once all views that still vote agree.
    """
    while True:
        right = np.einsum("vcc->vc", agreement.confusion)
        missing, extra = (agreement.confusion.sum(axis) - right for axis in (2, 1))
        found = contradictions(right, missing, extra, views, ids, "points")
        scores = {views.index(one.view): one.score for one in reversed(found)}  # of each view its worst
        scores = {view: score for view, score in scores.items() if agreement.voting[view]}
        if not scores:
            return found
        agreement.silence([view for view, score in scores.items() if score >= WORST * max(scores.values())])


def issues_of(found: Sequence[Contradiction], names: Mapping[int, str], masks: int) -> list[Issue]:
    """Return an issue for each object, from contradictions of one kind, the worst first. masks: number of them."""
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
            f"{len(of)} of {masks} masks of {class_id} ({names[class_id]}) contradict {witnesses}, worst first: "
            f"{named(of)}; correct them where contradicted.png shows it, or remove them (a view without a mask does "
            "not vote)."
        )
        remedy = "reprojection outvotes single views, but not many; without it they pull Gaussians to the wrong class"
        views = tuple(one.view for one in of)
        issues.append(Issue("warning", "contradicted", message, f"{cost}; {remedy}", views, (class_id,)))
    return issues
