"""Issues of whole views that disagree with the others: exchanged ids, inverted masks, objects that only some show."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from beags_plugin.masks.check.consistency import AGREEMENT, LEAST_POINTS, MOST, UNSEEN, Agreement
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import Issue, named, percent
from beags_plugin.system.wording import amount, verb

HARDLY = 0.1  # least pixels of an object in a view that shows it, as a share of the most that any view has


def views_against_others(
    agreement: Agreement, files: MaskFiles, coverage: Coverage, names: Mapping[int, str]
) -> list[Issue]:
    """Return an issue for each disagreement; ranks of ``agreement`` are indices in ``coverage.ids``."""
    titles = [f"{i} ({names[i]})" for i in coverage.ids]
    absent = _absent(agreement, files, coverage, titles)
    groups: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for renamed in agreement.renamed():
        groups.setdefault(tuple(sorted(renamed.instead.items())), []).append(renamed.view)
    issues = list(absent.values())
    for pairs, views in groups.items():
        (true, new), *more = pairs
        alone = true == 0 and not more  # no exchange, as nothing else in the view became background
        if alone and new in absent:
            continue
        ranks = sorted({new for _, new in pairs} - {0})
        wrong, all_of = (int(coverage.pixels[rows][:, ranks].sum()) for rows in (views, slice(None)))
        cost = (
            f"{wrong} pixels ({percent(wrong, all_of)} of these ids) vote for the wrong object; reprojection "
            "outvotes single views, but not many"
        )
        if alone:
            kind, message = "only view", f"{_only(files, views)} {titles[new]} there: {_remedy(len(views))}"
            cost = f"reprojection outvotes {wrong} pixels ({percent(wrong, all_of)} of this id)"
        else:
            inverted = any(0 in pair for pair in pairs)
            kind = "inverted" if inverted else "swapped ids"
            says = ", ".join(f"{titles[new]} instead of {titles[true]}" for true, new in pairs)
            these = "this mask" if len(views) == 1 else "these masks"
            remedy = f"invert {these}." if inverted else "give these objects the ids of the other views."
            masks, say = amount(len(views), "mask"), verb(len(views), "say")
            message = f"{masks} ({files.paths(views)}) {say} {says}, against the other views: {remedy}"
        issues.append(Issue("warning", kind, message, cost, tuple(files.stems[view] for view in views)))
    return issues


def _absent(agreement: Agreement, files: MaskFiles, coverage: Coverage, titles: list[str]) -> dict[int, Issue]:
    """Find objects, by rank, that most views should show according to the other masks, but lack."""
    trained, issues = np.asarray(files.trained) & coverage.usable, {}
    for rank in range(1, len(titles)):
        labels = agreement.labels[agreement.votes[:, rank] > 0]
        pixels = np.where(trained, coverage.pixels[:, rank], 0)
        # The second try leaves out slivers, where they outvote whole objects.
        for shows in (pixels > 0, pixels > HARDLY * pixels.max()):
            showing = np.flatnonzero(shows).tolist()
            inside, seen = (points.sum(1) for points in (labels[:, shows] == rank, labels[:, shows] != UNSEEN))
            agreed = labels[(inside >= min(2, len(showing))) & (inside >= AGREEMENT * seen)]
            if showing and len(agreed) >= LEAST_POINTS:
                break
        else:
            continue
        background = (agreed == 0).mean(0)  # share of these points that a view labels background
        lacking: list[int] = np.flatnonzero(trained & ~shows & (background >= MOST)).tolist()
        if len(lacking) > len(showing):
            stems = tuple(files.stems[view] for view in lacking)
            issues[rank] = Issue(
                "warning",
                "absent",
                f"{_only(files, showing)} {titles[rank]}, but {len(lacking)} more views of {int(trained.sum())} should "
                f"show it too and have little or none of it ({named(stems)}): {_remedy(len(showing))}",
                f"{len(lacking)} views vote for the background there, {len(showing)} for the object; a view without a "
                "mask does not vote",
                stems,
                (coverage.ids[rank],),
            )
    return issues


def _only(files: MaskFiles, views: list[int]) -> str:
    one = len(views) == 1
    return f"{files.paths(views)} {'is the only view that shows' if one else 'are the only views that show'}"


def _remedy(views: int) -> str:
    right = "it is right" if views == 1 else "they are right"
    return f"if {right}, mask the object in the others too, or remove masks that are empty."
