"""How far the depth of runs of generated scenes is from the exact one: python -m benchmarks.depth_error RUN [RUN ...].

For each stage of a run, over the pixels of all held-out views that show a surface: the median of |depth - exact|, in
per cent of the exact depth, of the rendered median and expected depths, and the share of pixels without a depth.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch


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


def measure(config_path: Path) -> list[DepthError]:
    """Return the errors of a run of a generated scene, before refinement (if it has kept that) and after."""
    from beags_plugin.plugin.objects.evaluate import EvaluatedRun
    from beags_plugin.plugin.runs.read import read_transform
    from beags_plugin.rasterizers.rendering import surfel_inputs

    run = EvaluatedRun(config_path)
    folder = run.stages["after"].config.data_path / "ground_truth" / "depth"
    if not folder.is_dir():
        sys.exit(f"{folder} is missing: only generated scenes have exact depth.")
    transform = read_transform(config_path.parent)
    scale = 1.0 if transform is None else transform[1]
    names = [Path(name).stem for name in run.views.manager.eval_dataset.image_filenames]
    found = []
    for stage, scene in run.stages.items():
        surfels = scene.surfels()
        errors: dict[str, list[np.ndarray]] = {"median": [], "expected": []}
        missing: list[np.ndarray] = []
        for name, camera in zip(names, run.views.cameras("eval"), strict=True):
            exact = np.load(folder / f"{name}.npy") * scale
            drawn = run.rasterizer.rasterize(surfel_inputs(surfels, camera), camera, run.settings, torch.zeros(3))
            surface = np.isfinite(exact) & (exact > 0)
            assert drawn.median_depth is not None and drawn.depth is not None
            for kind, depth in (("median", drawn.median_depth), ("expected", drawn.depth)):
                here = depth.cpu().numpy()
                shown = surface & (here > 0)
                errors[kind].append(np.abs(here - exact)[shown] / exact[shown])
            missing.append(drawn.median_depth.cpu().numpy()[surface] <= 0)
        medians = {kind: float(np.median(np.concatenate(values))) for kind, values in errors.items()}
        found.append(DepthError(run.name, stage, **medians, without=float(np.concatenate(missing).mean())))
    return found


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
    main()
