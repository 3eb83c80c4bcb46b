"""How many clicks an object takes: ``python -m beags_benchmarks.studies.clicks CONFIG [CONFIG ...]``.

Each config is of a run whose Gaussians have classes, best one refined with ``--pipeline.model.refiner none`` and
``--pipeline.model.refine-steps 1``, so that its geometry is that of the base. The classes are the truth. A simulated
user clicks each object out of the whole scene: first into the view of six that shows most of it, then into the middle
of the largest area, in any of the six, that is wrong. Printed is the IoU of the object's Gaussians after each click,
in %, each Gaussian counted by its weight in the training views.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.masks.sources.cut import MARK
from beags_plugin.picking.cutter import Cutter, ViewMarks
from beags_plugin.picking.sight import seen_from
from beags_plugin.rasterizers.rendering import geometry_inputs
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError

VIEWS = 6
LEAST_ERROR = 2e-4  # share of a picture below which an error is not clicked


class _Click(NamedTuple):
    area: float  # share of the picture that the error covers
    view: int
    row: int
    column: int
    inside: bool


@dataclass(frozen=True)
class Scene:
    """A scene with classes and the views that are clicked.

    classes: [N] int64. weights: [N] float64, of the Gaussians in the training views. cameras, fronts: of the clicked
    views; a front is [H, W] int64, the Gaussian with the largest weight at each pixel, or -1.
    """

    cutter: Cutter
    classes: Tensor
    weights: Tensor
    cameras: Sequence[Camera]
    fronts: Sequence[np.ndarray]

    @classmethod
    def of_run(cls, run: Run) -> Scene:
        """Read a scene; raises ``UserError`` for a run without classes."""
        state, cameras = run.assigned, run.viewpoints.cameras
        surfels = state.surfels()
        weights, _ = seen_from(surfels, cameras, run.rasterizer, run.settings)
        chosen = [cameras[i] for i in range(0, len(cameras), max(1, len(cameras) // VIEWS))][:VIEWS]
        inputs = geometry_inputs(surfels)
        fronts = [run.rasterizer.dominant_gaussian(inputs, each, run.settings).cpu().long().numpy() for each in chosen]
        cutter = Cutter(surfels, cameras, run.rasterizer, run.settings)
        return cls(cutter, state.state["class_ids"].cpu().long(), torch.from_numpy(weights), chosen, fronts)

    def overlaps(self, class_id: int, clicks: int) -> list[float]:
        """Return the IoU, 0..1, of a class's Gaussians after each of ``clicks`` simulated clicks.

        A click that the cut refuses leaves the object as it is. Where no error is left to click on, the last value
        stands for the rest.
        """
        truth = self.classes == class_id
        picked = torch.zeros_like(truth)
        marks: list[ViewMarks] = []
        found: list[float] = []
        while len(found) < clicks and (click := self._next(truth.numpy(), picked.numpy(), first=not marks)):
            marks.append(_mark(self.cameras[click.view], click))
            try:
                picked = self.cutter.solve(marks)
            except UserError as error:
                print(f"    refused: {error}")
            common, either = self.weights[truth & picked].sum(), self.weights[truth | picked].sum()
            found.append(float(common / either.clamp(min=1e-12)))
        return found + found[-1:] * (clicks - len(found))

    def _next(self, truth: np.ndarray, picked: np.ndarray, first: bool) -> _Click | None:
        best: _Click | None = None
        for view, front in enumerate(self.fronts):
            there, wanted, got = front >= 0, truth[front], picked[front]
            for inside, wrong in ((True, there & wanted & ~got), (False, there & got & ~wanted)):
                click = _middle(wrong, view, inside)
                if click and click.area >= (0.0 if first else LEAST_ERROR) and (best is None or click.area > best.area):
                    best = click
        return best


def _middle(wrong: np.ndarray, view: int, inside: bool) -> _Click | None:
    """Return a click on the place deepest inside the largest connected part of ``wrong`` [H, W] bool."""
    clean = cv2.morphologyEx(wrong.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, parts, sizes, _ = cv2.connectedComponentsWithStats(clean)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(sizes[1:, cv2.CC_STAT_AREA]))
    depth = cv2.distanceTransform(np.pad((parts == largest).astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    row, column = np.unravel_index(int(np.argmax(depth)), depth.shape)
    return _Click(float(sizes[largest, cv2.CC_STAT_AREA]) / wrong.size, view, int(row), int(column), inside)


def _mark(camera: Camera, click: _Click) -> ViewMarks:
    radius = max(1, round(MARK * float(np.hypot(camera.height, camera.width))))
    numbers = torch.full((camera.height, camera.width), IGNORE, dtype=torch.int32)
    rows, columns = (slice(max(at - radius, 0), at + radius + 1) for at in (click.row, click.column))
    numbers[rows, columns] = 0
    return ViewMarks("a simulated view", camera, numbers, (click.inside,))


def measure(config: Path, clicks: int) -> Mapping[str, list[float]]:
    """Return the IoU of each object of a run after each click, by name."""
    run = Run(config)
    scene = Scene.of_run(run)
    present = {int(each) for each in scene.classes.unique()} - {BACKGROUND, IGNORE}
    return {run.scene.classes.get(each, str(each)): scene.overlaps(each, clicks) for each in sorted(present)}


def main() -> None:
    """Print a line for each object of each run, and the mean of a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="+", type=Path, help="config.yml of runs with classes")
    parser.add_argument("--clicks", type=int, default=8)
    arguments = parser.parse_args()
    for config in arguments.configs:
        print(config)
        found = measure(config, arguments.clicks)
        for name, values in found.items():
            print(f"  {name:20s}", *(f"{100 * value:5.1f}" for value in values))
        print(f"  {'mean':20s}", *(f"{100 * value:5.1f}" for value in np.mean(list(found.values()), axis=0)))


if __name__ == "__main__":
    main()
