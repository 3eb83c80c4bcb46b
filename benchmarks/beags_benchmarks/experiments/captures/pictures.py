"""A sheet of one capture: a held-out photo, its render by each row, and each object alone from all sides."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from beags_benchmarks.experiments.engines.interface import Outcome
from beags_benchmarks.experiments.objects_picture import captioned
from beags_benchmarks.experiments.trials import VariantTrial

if TYPE_CHECKING:
    from torch import Tensor

    from beags_plugin.core.cameras import Camera
    from beags_plugin.core.surfels import Surfels
    from beags_plugin.evaluation.records import EvalView
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.rasterizers.interface import RasterSettings
    from beags_plugin.runs.read import SavedScene

SIDE = 200  # pixels of a picture of an object, and height of one of the scene
AROUND, ABOVE = 4, 20.0  # pictures on a circle, degrees above the horizon
BENEATH, BELOW = 2, -35.0
STRAYS = 0.03  # share of an object's Gaussians left out of the picture at each end of each axis
MARGIN = 0.1  # margin around the others, in sides of their box
LETTER = 7  # largest width of a letter of a caption, pixels


def write_sheet(path: Path, runs: Sequence[VariantTrial], outcomes: Mapping[str, Outcome]) -> bool:
    """Write the sheet of one scene, a line for each row of its first seed; returns whether any row has a result.

    All rows have the same cameras: an object's box is the median of its boxes in the rows.
    """
    from beags_plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.pictures.cells import as_bytes, below, beside, cell, write_picture
    from beags_plugin.pictures.objects import render_alone
    from beags_plugin.runs.read import read_run

    own = [run for run in runs if run.seed == runs[0].seed]
    finished = [run for run in own if outcomes[run.trial.digest].failed is None]
    if not finished:
        return False
    configs = {run.variant.name: outcomes[run.trial.digest].folder / "run" / "config.yml" for run in finished}
    first = EvaluatedRun(configs[finished[0].variant.name])
    scenes = {name: read_run(config) for name, config in configs.items()}
    view, lines = _held_out(first), []
    assert view.image is not None
    settings = replace(first.settings, geometry=False, distortion=False)
    size = max(1, round(SIDE * view.camera.width / view.camera.height)), SIDE
    photo = as_bytes(view.image)
    stands = {class_id: _stand(class_id, first, scenes) for class_id in first.classes if class_id != 0}
    for name, scene in scenes.items():
        render = render_alone(scene.surfels(), view.camera, settings, first.rasterizer, "black")
        images, captions = [(photo, size), (render, size)], [view.name, name]
        for class_id, (cameras, orbit_settings) in stands.items():
            alone = _alone(scene, class_id)
            for camera in cameras:
                image = render_alone(alone, camera, orbit_settings, first.rasterizer, "checker")
                images.append((image, (SIDE, SIDE)))
            captions += [first.classes[class_id], *[""] * (AROUND - 1), "from below", *[""] * (BENEATH - 1)]
        texts = captioned(captions, max(size[0] // LETTER, 1))
        lines.append(beside([cell(image, of, text) for (image, of), text in zip(images, texts, strict=True)]))
    write_picture(path, below(lines))
    return True


def _held_out(run: EvaluatedRun) -> EvalView:
    """Return the first held-out view with a silhouette, else the first."""
    traced = (view for view in run.views if view.silhouettes)
    return next(traced, run.views[0])


def _alone(scene: SavedScene, class_id: int) -> Surfels:
    from beags_plugin.core.select import select_class

    return select_class(scene.surfels(), scene.members, class_id)[0]


def _stand(class_id: int, first: EvaluatedRun, scenes: Mapping[str, SavedScene]) -> tuple[list[Camera], RasterSettings]:
    """Return the cameras around an object, from above the horizon and then from below, and their settings."""
    from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings

    boxes = [_bulk(part) for scene in scenes.values() if len(part := _alone(scene, class_id))]
    if not boxes:
        boxes = [(torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))]
    low, high = (torch.stack(corners).median(dim=0).values for corners in zip(*boxes, strict=True))
    stand = orbit_frame(low, high, first.views.cameras("train"))
    cameras = [*orbit(stand, AROUND, SIDE, ABOVE), *orbit(stand, BENEATH, SIDE, BELOW)]
    return cameras, orbit_settings(stand)


def _bulk(surfels: Surfels) -> tuple[Tensor, Tensor]:
    """Return the corners, [3] float64 each, of a box with a margin around all but the outermost centres.

    Strays may leave the picture; otherwise a few of them would make everything small.
    """
    shares = torch.tensor([STRAYS, 1.0 - STRAYS], dtype=torch.float64)
    low, high = torch.quantile(surfels.means.detach().cpu().double(), shares, dim=0)
    return low - MARGIN * (high - low), high + MARGIN * (high - low)
