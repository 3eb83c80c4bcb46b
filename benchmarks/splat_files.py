"""Size and loss of splat files: python -m benchmarks.splat_files RUN/config.yml [RUN/config.yml ...].

Each object, and the whole scene, is written in every splat format, read again (``importers``) and drawn alone, on
white, from the held-out views. Printed per format: bytes, and PSNR against what the .ply draws, over the pixels that
either draws on (alpha above 1/255), all views together. "html" is the page without the 2.6 MB of its viewer: colours
that do not change with the view, and below it what the degree-0 coefficients alone would give.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from beags_plugin.core.cameras import Camera
from beags_plugin.core.flattening import flatten
from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import make_exporter
from beags_plugin.export.page_colors import seen_colors
from beags_plugin.export.web_page import recording
from beags_plugin.importers.base import read_scene
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.evaluate import EvaluatedRun
from beags_plugin.rasterizers.interface import MIN_ALPHA
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.run import Run
from beags_plugin.surfaces.item import ExportItem, Viewpoints

SUFFIXES = {"ply": "ply", "compressed-ply": "compressed.ply", "spz": "spz", "splat": "splat", "sog": "sog"}


def read(path: Path) -> Surfels:
    """Return the Gaussians of a file that was written here, as discs."""
    return flatten(read_scene(path).gaussians)[0]


def drawn(surfels: Surfels, camera: Camera, views: Viewpoints) -> tuple[Tensor, Tensor]:
    """Return the picture [H, W, 3] 0..1 on white, and where something is drawn [H, W] bool."""
    settings = replace(views.settings, geometry=False)
    with torch.no_grad():
        made = views.rasterizer.rasterize(surfel_inputs(surfels, camera), camera, settings, torch.ones(3))
    return made.color.clamp(0, 1), made.alpha > MIN_ALPHA


def psnr(before: Surfels, after: Surfels, cameras: list[Camera], views: Viewpoints) -> float:
    """Return the PSNR in dB over the pixels of all cameras on which either scene draws."""
    squares, numbers = 0.0, 0
    for camera in cameras:
        (one, on_one), (other, on_other) = (drawn(surfels, camera, views) for surfels in (before, after))
        counted = on_one | on_other
        squares += float((one - other)[counted].double().square().sum())
        numbers += 3 * int(counted.sum())
    return float(-10 * torch.log10(torch.tensor(squares / max(numbers, 1), dtype=torch.float64)))


def measure(config_path: Path) -> None:
    """Print the table of one run."""
    run = Run(config_path)
    scene, views = run.assigned, run.viewpoints
    run = EvaluatedRun(config_path)
    cameras, surfels = run.views.cameras("eval"), scene.surfels().detach()
    present = [class_id for class_id in scene.members.present() if class_id != BACKGROUND]
    parts = {run.classes[each]: select_class(surfels, scene.members, each)[0] for each in present}
    print(f"{run.name}, {len(cameras)} held-out views, degree {surfels.sh_degree}\n")
    print("| | Gaussians | " + " | ".join(f"{name}, PSNR" for name in SUFFIXES) + " | html, PSNR | degree 0 |")
    print("|---|" + "---|" * (len(SUFFIXES) + 3))
    for name, part in {**parts, "whole scene": surfels}.items():
        item = ExportItem(name, part, torch.zeros(len(part), dtype=torch.int32), views)
        cells = []
        with tempfile.TemporaryDirectory() as folder:
            for kind, suffix in SUFFIXES.items():
                path = Path(folder) / f"file.{suffix}"
                make_exporter(kind).write(path, item)
                size = f"{path.stat().st_size / 1000:.1f} KB"
                cells.append(size if kind == "ply" else f"{size}, {psnr(part, read(path), cameras, views):.1f}")
        seen = seen_colors(part, views, lambda done: None)
        cells.append(f"{len(recording(item, seen)) / 1000:.1f} KB, {psnr(part, seen.surfels, cameras, views):.1f}")
        bare = replace(part, sh_rest=part.sh_rest[:, :0])
        cells.append(f"{psnr(part, bare, cameras, views):.1f}")
        print(f"| {name} | {len(part)} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for each in sys.argv[1:]:
        measure(Path(each))
