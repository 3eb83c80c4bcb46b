"""Pictures of objects as each variant cuts them out, side by side."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.per_object import OBJECT
from beags_benchmarks.experiments.trials import OPTIONS, Trial, VariantTrial

if TYPE_CHECKING:
    from beags_plugin.evaluation.records import EvalView
    from beags_plugin.objects.evaluate import EvaluatedRun

_SIDE = 150  # pixels of a cell
_LETTERS = 26  # letters in a line of a caption
_COLUMNS = 10  # variants of a picture
_LINES = 16  # most objects of a picture


def plot_objects(path: Path, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> list[Path]:
    """Draw a line for each object, in the held-out view that shows most of it; a column for each variant.

    Only the largest objects of each scene are drawn, ``_LINES`` in all or one for each scene. Many variants are divided
    among several pictures: ``path``, then those with 2, 3, .. in their names. Returns their paths. A failed variant has
    an empty cell.
    """
    from beags_plugin.pictures.cells import write_picture

    lines, scenes = [], dict.fromkeys(run.scene.name for run in runs)
    for scene in scenes:
        of_scene = [run for run in runs if run.scene.name == scene and run.seed == runs[0].seed]
        lines += _objects(scene, of_scene, outcomes, most=max(_LINES // len(scenes), 1))
    paths = []
    for picture in pages(lines):
        paths.append(path if not paths else path.with_stem(f"{path.stem}-{len(paths) + 1}"))
        write_picture(paths[-1], picture)
    return paths


def pages(lines: Sequence[Sequence[np.ndarray]], columns: int = _COLUMNS) -> list[np.ndarray]:
    """Return pictures of lines of cells: each has the first cell of a line and at most ``columns`` of the others."""
    from beags_plugin.pictures.cells import below, beside

    if not lines:
        return []
    count = len(lines[0]) - 1
    number = max(math.ceil(count / columns), 1)
    ends = [1 + count * page // number for page in range(number + 1)]
    return [
        below([beside([line[0], *line[first:last]]) for line in lines])
        for first, last in zip(ends, ends[1:], strict=False)
    ]


def _objects(
    scene: str, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome], most: int
) -> list[list[np.ndarray]]:
    """Return the cells of the ``most`` largest objects of a scene, each with its photo first."""
    from beags_plugin.core.select import select_class
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.pictures.cells import as_bytes, cell, crop, square_around
    from beags_plugin.pictures.object_cells import alone, over_board
    from beags_plugin.runs.read import read_run

    finished = [trial for run in runs for trial in run.trials if outcomes[trial.digest].failed is None]
    if not finished:
        return []
    first = EvaluatedRun(outcomes[finished[0].digest].folder / "run/config.yml")
    scenes = {trial.digest: read_run(outcomes[trial.digest].folder / "run/config.yml") for trial in finished}
    rows = []
    for class_id, (view, truth) in sorted(_largest(first, most).items()):
        name = first.classes[class_id]
        assert view.image is not None
        images: list[np.ndarray | None] = []
        for run in runs:
            trial = next((trial for trial in run.trials if _cuts(trial, name)), None)
            trained = None if trial is None else scenes.get(trial.digest)
            image = None
            if trained is not None:
                part = select_class(trained.surfels(), trained.members, class_id)[0]
                image = alone(part, view.camera, first.settings, first.rasterizer)
            images.append(image)
        shape = next((image.shape[:2] for image in images if image is not None), truth.shape)
        window = square_around(truth if truth.shape == shape else np.ones(shape, dtype=bool))
        photo = as_bytes(view.image)
        white = np.full((_SIDE, _SIDE, 3), 255, np.uint8)
        pictures = [
            crop(photo, window),
            *(white if image is None else over_board(crop(image, window), _SIDE) for image in images),
        ]
        captions = captioned([f"{scene}: {name}", *(run.variant.name for run in runs)])
        rows.append([cell(image, (_SIDE, _SIDE), text) for image, text in zip(pictures, captions, strict=True)])
    return rows


def captioned(names: Sequence[str], letters: int = _LETTERS) -> list[str]:
    """Return names in lines of at most ``letters`` letters, all with the same number of lines, so that cells align."""
    lines = [textwrap.wrap(name, letters) or [""] for name in names]
    most = max(map(len, lines))
    return ["\n".join([*each, *[""] * (most - len(each))]) for each in lines]


def _largest(run: EvaluatedRun, most: int) -> dict[int, tuple[EvalView, np.ndarray]]:
    """Return the largest objects: id to the held-out view that shows most pixels of it, and its mask [H, W] bool."""
    from beags_plugin.evaluation.truths import extracted_truth

    masks: list[tuple[int, int, EvalView, np.ndarray]] = []
    for class_id in sorted(run.classes):
        truths = [(view, extracted_truth(view, class_id)) for view in run.views] if class_id != 0 else []
        seen = [(int(truth.mask.sum()), view, truth.mask) for view, truth in truths if truth is not None]
        if seen:
            pixels, view, mask = max(seen, key=lambda each: each[0])
            masks.append((pixels, class_id, view, mask.cpu().numpy()))
    masks.sort(key=lambda each: -each[0])
    return {class_id: (view, mask) for _, class_id, view, mask in masks[:most]}


def _cuts(trial: Trial, name: str) -> bool:
    """Return whether a trial takes out the object, as all objects or as its only one."""
    return trial.overrides.get(OPTIONS, {}).get(OBJECT, name) == name
