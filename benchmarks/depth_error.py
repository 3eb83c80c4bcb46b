"""How far the depth of runs of generated scenes is from the exact one: python -m benchmarks.depth_error RUN [RUN ...].

For each stage of a run, over the pixels of all held-out views that show a surface: the median of |depth - exact|, in
per cent of the exact depth, of the rendered median and expected depths, each where there is one, and the share of
pixels without a median depth.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from beags_plugin.core.cameras import Camera
from beags_plugin.system.errors import UserError, print_user_errors_plainly


@dataclass(frozen=True)
class DepthError:
    """Errors of one stage: medians of |depth - exact| / exact, and the share of pixels without a depth."""

    run: str
    stage: str
    median: float
    expected: float
    without: float

    def row(self) -> str:
        cells = " | ".join(f"{100 * value:.2f}" for value in (self.median, self.expected, self.without))
        return f"| {self.run} {self.stage} | {cells} |"


def relative_errors(depth: np.ndarray, exact: np.ndarray) -> np.ndarray:
    """Return |depth - exact| / exact, [P], of the pixels with a surface that have a depth; arguments are [H, W]."""
    shown = surface(exact) & (depth > 0)
    return np.abs(depth - exact)[shown] / exact[shown]


def surface(exact: np.ndarray) -> np.ndarray:
    """Return which pixels show a surface, [H, W] bool."""
    return np.isfinite(exact) & (exact > 0)


def measure(config_path: Path) -> list[DepthError]:
    """Return the errors of a run of a generated scene, before refinement (if it has kept that) and after.

    Raises ``UserError`` where there is no exact depth, or it has another size than the views.
    """
    from beags_plugin.plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.plugin.runs.read import read_transform
    from beags_plugin.rasterizers.rendering import surfel_inputs

    run = EvaluatedRun(config_path)
    folder = run.stages["after"].config.data_path / "ground_truth" / "depth"
    transform = read_transform(config_path.parent)
    scale = 1.0 if transform is None else transform[1]
    names = [Path(name).stem for name in run.views.manager.eval_dataset.image_filenames]
    cameras = run.views.cameras("eval")
    exact = [scale * _read(folder / f"{name}.npy", camera) for name, camera in zip(names, cameras, strict=True)]
    found = []
    for stage, scene in run.stages.items():
        surfels, median, expected = scene.surfels(), [], []
        for camera in cameras:
            drawn = run.rasterizer.rasterize(surfel_inputs(surfels, camera), camera, run.settings, torch.zeros(3))
            assert drawn.median_depth is not None and drawn.depth is not None
            median.append(drawn.median_depth.cpu().numpy())
            expected.append(drawn.depth.cpu().numpy())
        errors = [
            float(np.median(np.concatenate(list(map(relative_errors, depths, exact))))) for depths in (median, expected)
        ]
        without = np.concatenate([depth[surface(truth)] <= 0 for depth, truth in zip(median, exact, strict=True)])
        found.append(DepthError(run.name, stage, errors[0], errors[1], float(without.mean())))
    return found


def _read(path: Path, camera: Camera) -> np.ndarray:
    """Return the exact depth of a view, [H, W], in the unit of its scene."""
    if not path.is_file():
        raise UserError(f"{path} is missing: only generated scenes have exact depth.")
    exact = np.load(path)
    if exact.shape != (camera.height, camera.width):
        raise UserError(f"{path} is {exact.shape[1]} x {exact.shape[0]}, but the run's views are {camera.width} x "
                        f"{camera.height}: exact depth is of the photos' full size.")  # fmt: skip
    return exact


def main() -> None:
    """Measure the runs that are named."""
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    print("| run | median depth, % | expected depth, % | without, % |\n| --- | --- | --- | --- |", flush=True)
    with torch.no_grad():
        for path in map(Path, sys.argv[1:]):
            config = path if path.is_file() else path / "config.yml"
            print(*(error.row() for error in measure(config)), sep="\n", flush=True)


if __name__ == "__main__":
    print_user_errors_plainly()
    main()
