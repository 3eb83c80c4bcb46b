"""Issues of whole views that disagree with the others: exchanged ids, inverted masks."""

from __future__ import annotations

from collections.abc import Mapping

from beags_plugin.masks.check.consistency import Agreement
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import Issue, percent


def views_against_others(
    agreement: Agreement, files: MaskFiles, coverage: Coverage, names: Mapping[int, str]
) -> list[Issue]:
    """Describe the disagreements as issues; ranks of ``agreement`` are indices in ``coverage.ids``."""
    titles = [f"{i} ({names[i]})" for i in coverage.ids]
    groups: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for found in agreement.renamed():
        groups.setdefault(tuple(sorted(found.instead.items())), []).append(found.view)
    issues = []
    for pairs, views in groups.items():
        says = ", ".join(f"{titles[new]} instead of {titles[true]}" for true, new in pairs)
        inverted = any(0 in pair for pair in pairs)
        ranks = sorted({new for _, new in pairs} - {0})
        wrong, all_of = (int(coverage.pixels[rows][:, ranks].sum()) for rows in (views, slice(None)))
        issues.append(
            Issue(
                "warning",
                "inverted" if inverted else "swapped ids",
                f"{len(views)} masks ({files.paths(views)}) say {says}, against the other views: "
                + ("invert these masks." if inverted else "give these objects the ids of the other views."),
                f"{wrong} pixels ({percent(wrong, all_of)} of these ids) vote for the wrong object; reprojection "
                "outvotes single views, but not many",
                tuple(files.stems[view] for view in views),
            )
        )
    return issues
