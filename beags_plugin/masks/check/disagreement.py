"""What points in space tell about whole views: ids exchanged, objects lost, one object under two ids."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from beags_plugin.masks.check.consistency import Agreement
from beags_plugin.masks.check.files import Coverage, MaskFiles
from beags_plugin.masks.check.issues import Finding, percent


def views_against_others(
    agreement: Agreement, files: MaskFiles, coverage: Coverage, names: Mapping[int, str]
) -> list[Finding]:
    """The findings of ``agreement`` in words; its ranks are places in ``coverage.ids``."""
    titles = [f"{i} ({names[i]})" for i in coverage.ids]
    return [
        *_renamed(agreement, files, coverage, titles),
        *_twins(agreement, files, coverage, titles),
        *_lost(agreement, files, coverage, titles),
    ]


def _renamed(agreement: Agreement, files: MaskFiles, coverage: Coverage, titles: Sequence[str]) -> list[Finding]:
    groups: dict[tuple[tuple[int, int], ...], list[int]] = {}
    for found in agreement.renamed():
        groups.setdefault(tuple(sorted(found.instead.items())), []).append(found.view)
    findings = []
    for pairs, views in groups.items():
        says = ", ".join(f"{titles[new]} instead of {titles[true]}" for true, new in pairs)
        inverted = any(0 in pair for pair in pairs)
        ranks = sorted({new for _, new in pairs} - {0})
        wrong, all_of = (int(coverage.pixels[rows][:, ranks].sum()) for rows in (views, slice(None)))
        findings.append(
            Finding(
                "warning",
                "inverted" if inverted else "swapped ids",
                f"{len(views)} masks ({files.paths(views)}) say {says}, against the other views: "
                + ("invert these masks." if inverted else "give these objects the ids of the other views."),
                f"{wrong} pixels ({percent(wrong, all_of)} of these ids) vote for the wrong object; reprojection "
                "outvotes single views, but not many",
                tuple(files.stems[view] for view in views),
            )
        )
    return findings


def _twins(agreement: Agreement, files: MaskFiles, coverage: Coverage, titles: Sequence[str]) -> list[Finding]:
    findings = []
    for twins in agreement.twins(coverage.pixels > 0):
        both = [int((coverage.pixels[:, rank] > 0).sum()) for rank in (twins.first, twins.second)]
        findings.append(
            Finding(
                "warning",
                "two ids",
                f"ids {titles[twins.first]} ({both[0]} views) and {titles[twins.second]} ({both[1]} views) are never "
                f"in one mask of {files.folder} but in the same place: if they are one object, give it one id.",
                f"each id has {percent(min(both), sum(both))} to {percent(max(both), sum(both))} of the object's "
                "views: its Gaussians go to the one or the other, and neither is extracted whole",
            )
        )
    return findings


def _lost(agreement: Agreement, files: MaskFiles, coverage: Coverage, titles: Sequence[str]) -> list[Finding]:
    groups: dict[int, list[int]] = {}
    for found in agreement.lost():
        groups.setdefault(found.class_rank, []).append(found.view)
    findings = []
    for rank, views in groups.items():
        areas = coverage.pixels[:, rank]
        usual = int(np.median(areas[areas > 0]))
        findings.append(
            Finding(
                "note",
                "absent",
                f"{titles[rank]} is absent from {len(views)} masks ({files.paths(views)}), though "
                "it lies in their image: fine if something hides it, else mask it there.",
                f"if it shows, about {len(views) * usual} pixels vote for the background "
                f"({percent(len(views), int((areas > 0).sum()) + len(views))} of its views)",
                tuple(files.stems[view] for view in views),
            )
        )
    return findings
