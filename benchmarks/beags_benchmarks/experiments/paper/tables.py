"""The paper's tables with our results beside them, and lists of missing parts, for a terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from beags_benchmarks.experiments.paper.data_sets import PaperDataSet
from beags_benchmarks.experiments.paper.on_disk import SceneOnDisk
from beags_benchmarks.experiments.report import number, plain_table
from beags_benchmarks.experiments.results import ResultRow, means

if TYPE_CHECKING:
    from rich.table import Table

KINDS = {"extracted": "objects rendered alone", "rendered": "objects in the whole scene"}
_MISSING = "–"


@dataclass(frozen=True)
class Outcomes:
    """Results: rows, and for each row the truth of its extracted masks ("silhouette", "visible", "both", None)."""

    rows: Sequence[ResultRow]
    truths: Mapping[tuple[str, str], str | None]  # (scene, variant)

    def of(self, data_set: PaperDataSet) -> list[ResultRow]:
        """Return the rows of a data set's scenes."""
        return [row for row in self.rows if row.scene.split("/")[0] == data_set.name]


def missing_lines(scenes: Sequence[SceneOnDisk]) -> list[str]:
    """Return a line for each part that is not on disk; the absent scenes of a data set share a line."""
    lines = []
    for data_set in dict.fromkeys(scene.data_set.name for scene in scenes):
        own = [scene for scene in scenes if scene.data_set.name == data_set]
        if absent := [scene.name for scene in own if not scene.folder.is_dir()]:
            which = f"{'scene' if len(absent) == 1 else 'scenes'} {', '.join(absent)}"
            belong = "belongs" if len(absent) == 1 else "belong"
            lines.append(f"missing: {own[0].data_set.title}: the {which} {belong} in {own[0].folder.parent}")
        for scene in own:
            title = f"{scene.data_set.title}, {scene.name}"
            lines += [f"missing: {title}: {what}" for what in scene.missing]
            lines += [f"note: {title}: {what}" for what in scene.notes]
    return lines


def paper_tables(data_sets: Sequence[PaperDataSet], methods: Sequence[str], outcomes: Outcomes) -> list[Table | str]:
    """Return tables of extracted masks, rendered masks and PSNR, with the paper's figures beside ours.

    methods: our methods, in order; methods that only the paper has come after them.
    """
    printed: list[Table | str] = []
    for kind, what in KINDS.items():
        scored = [each for each in data_sets if kind in each.metrics]
        others = (name for each in scored for name in each.figures.get(kind, {}))
        names = [*methods, *dict.fromkeys(name for name in others if name not in methods)]
        heads = [head for each in scored for head in (f"{each.title}\nours", "\nthe paper's")]
        rows = [[name, *(cell for each in scored for cell in _cells(each, kind, name, outcomes))] for name in names]
        if scored:
            printed.append(plain_table(f"{kind.capitalize()}: {what}; IoU / BIoU, %", ["method", *heads], rows))
    printed.append(_psnr_table([each for each in data_sets if "psnr" in each.metrics], methods, outcomes))
    legends = {
        "*": "fewer scenes than the data set's file names: not to be compared with the paper's mean.",
        "+": "some or all extracted objects are compared with visible masks: their silhouettes are missing.",
    }
    cells = [str(cell) for table in printed if not isinstance(table, str) for c in table.columns for cell in c.cells]
    printed += [f"{mark} {what}" for mark, what in legends.items() if any(mark in cell for cell in cells)]
    return printed


def mean_row(data_set: PaperDataSet, method: str, outcomes: Outcomes) -> ResultRow | None:
    """Return a method's mean over the scenes of a data set that were run; None without scenes."""
    rows = [row for row in outcomes.of(data_set) if row.variant.name == method]
    return means(rows)[0] if rows else None


def _cells(data_set: PaperDataSet, kind: str, method: str, outcomes: Outcomes) -> tuple[str, str]:
    """Return our cell with its marks, and the paper's."""
    paper = data_set.figures.get(kind, {}).get(method)
    theirs = _MISSING if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f}"
    row = mean_row(data_set, method, outcomes)
    if row is None:
        return _MISSING, theirs
    if row.failed:
        return "failed", theirs
    pair = [row.figures[f"{kind}_{metric}_after"] for metric in ("iou", "biou")]
    if pair == [None, None]:
        return _MISSING, theirs
    scored = {
        each.scene
        for each in outcomes.of(data_set)
        if each.variant.name == method and each.figures[f"{kind}_iou_after"] is not None
    }
    marks = "*" if len(scored) < len(data_set.scenes) else ""
    truths = {outcomes.truths.get((scene, method)) for scene in scored}
    marks += "+" if kind == "extracted" and truths - {"silhouette"} else ""
    return " / ".join(number(value, 1, 100.0) for value in pair) + marks, theirs


def _psnr_table(data_sets: Sequence[PaperDataSet], methods: Sequence[str], outcomes: Outcomes) -> Table:
    rows = []
    for method in methods:
        cells = []
        for each in data_sets:
            row = mean_row(each, method, outcomes)
            pair = [None, None] if row is None else [row.figures[f"psnr_{stage}"] for stage in ("before", "after")]
            fewer = row is not None and row.count < len(each.scenes) and pair != [None, None]
            cells.append((" / ".join(number(value, 1) for value in pair) if any(pair) else _MISSING) + "*" * fewer)
            paper = each.psnr if method == "bea-gs" else None
            cells.append(_MISSING if paper is None else f"{paper[0]:.1f} / {paper[1]:.1f}")
        rows.append([method, *cells])
    heads = [head for each in data_sets for head in (f"{each.title}\nours", "\nthe paper's")]
    return plain_table("PSNR of held-out views before / after refinement, dB", ["method", *heads], rows)
