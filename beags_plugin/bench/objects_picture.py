"""A picture of every object as each variant cuts it out, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from beags_plugin.bench.engines.interface import Outcome
from beags_plugin.bench.per_object import OBJECT
from beags_plugin.bench.trials import OPTIONS, Trial, VariantTrial

_SIDE = 150  # pixels of a cell


def plot_objects(path: Path, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> None:
    """Draw a line for each object of each scene, in the held-out view that shows most of it; a column for each variant.

    A variant that failed has an empty cell.
    """
    from beags_plugin.pictures.cells import below, wrapped, write_picture

    lines = []
    for scene in dict.fromkeys(run.scene.name for run in runs):
        of_scene = [run for run in runs if run.scene.name == scene and run.seed == runs[0].seed]
        lines += [wrapped([cells], 10**6)[0] for cells in _objects(scene, of_scene, outcomes)]
    if lines:
        write_picture(path, below(lines))


def _objects(scene: str, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> list[list[np.ndarray]]:
    """Return the cells of every object of a scene."""
    from beags_plugin.evaluation.run_metrics import extracted_truth
    from beags_plugin.pictures.cells import cell, crop, square_around
    from beags_plugin.pictures.contact_sheet import alone, cut_out
    from beags_plugin.plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.plugin.runs.read import read_run

    done = [trial for run in runs for trial in run.trials if outcomes[trial.digest].failed is None]
    if not done:
        return []
    first = EvaluatedRun(outcomes[done[0].digest].folder / "run/config.yml")
    scenes = {trial.digest: read_run(outcomes[trial.digest].folder / "run/config.yml") for trial in done}
    rows = []
    for class_id, name in sorted(first.classes.items()):
        truths = [(view, extracted_truth(view, class_id)) for view in first.views] if class_id != 0 else []
        sizes = [(int(truth.mask.sum()), at) for at, (_, truth) in enumerate(truths) if truth is not None]
        if not sizes:
            continue
        view, truth = truths[max(sizes)[1]]
        assert truth is not None and view.image is not None
        drawn: list[tuple[str, np.ndarray | None]] = []
        for run in runs:
            trial = next((trial for trial in run.trials if _cuts(trial, name)), None)
            found = None if trial is None else scenes.get(trial.digest)
            image = None
            if found is not None:
                image = alone(found.surfels(), found.members, class_id, view.camera, first.rasterizer, first.settings)
            drawn.append((run.variant.name, image))
        shown = truth.mask.cpu().numpy().copy()
        shape = next((image.shape[:2] for _, image in drawn if image is not None), shown.shape)
        window = square_around(shown if shown.shape == shape else np.ones(shape, dtype=bool))
        photo = (view.image.clamp(0, 1) * 255).byte().cpu().numpy()
        cells = [cell(crop(photo, window), (_SIDE, _SIDE), f"{scene}: {name}")]
        for caption, image in drawn:
            picture = np.full((_SIDE, _SIDE, 3), 255, np.uint8) if image is None else cut_out(image, window)
            cells.append(cell(picture, (_SIDE, _SIDE), caption))
        rows.append(cells)
    return rows


def _cuts(trial: Trial, name: str) -> bool:
    """Return whether a trial cuts the object out: all of them, or its own alone."""
    return trial.overrides.get(OPTIONS, {}).get(OBJECT, name) == name
