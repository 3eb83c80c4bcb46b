"""``beags render --underlay``: renderings of objects over faded held-out photos, on which to draw silhouettes by hand.

The paper made its ground truth of hidden parts in this way, over renderings of extracted objects. Silhouettes belong in
ground_truth/silhouettes, where evaluation reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from beags_plugin.core.select import select_class
from beags_plugin.objects.export import Progress
from beags_plugin.objects.extract import chosen_objects, file_name
from beags_plugin.objects.reproject_masks import ReprojectionOptions, data_to_reproject, mask_paths
from beags_plugin.rasterizers.rendering import surfel_inputs
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_whole

FADED, GREY = 0.35, 0.5  # share of the photo around the object, and the grey that it is mixed with


@dataclass(frozen=True)
class Underlays:
    """The pictures written, <object>/<photo>.png in ``folder``. silhouettes: the folder for the drawn silhouettes."""

    folder: Path
    count: int
    silhouettes: Path


def write_underlays(
    config_path: Path,
    objects: Sequence[str] = (),
    output: Path | None = None,
    progress: Progress | None = None,
    data: Path | None = None,
) -> Underlays:
    """Write a picture of each object in each held-out view, as large as the photo's file and with its lens distortion.

    config_path: config.yml of a refined (or assigned) run. objects: names; all but the background if empty. output:
    the folder; ``renders/underlay`` of the run if None. progress: receives (done, total) pictures. data: folder of the
    scene if it has moved. Raises ``UserError`` for a mistake, before anything is written.
    """
    run = Run(config_path, data)
    scene = run.assigned
    chosen = chosen_objects(scene, objects, run.folder)
    manager = data_to_reproject(run, ReprojectionOptions())
    folder = output or run.folder / "renders" / "underlay"
    if folder.exists() and not folder.is_dir():
        raise UserError(f"{folder} is a file: name a folder with --output.")
    rasterizer, settings = run.rasterizer, run.settings
    surfels = scene.surfels()
    parts = {name: select_class(surfels, scene.members, class_id)[0] for name, class_id in chosen.items()}
    views, paths = manager.views("eval"), mask_paths(manager.eval_dataset.image_filenames)
    for index, (view, path) in enumerate(zip(views, paths, strict=True)):
        faded = FADED * view.image.cpu() + (1.0 - FADED) * GREY
        for number, (name, part) in enumerate(parts.items()):
            with torch.no_grad():
                inputs = surfel_inputs(part, view.camera)
                render = rasterizer.rasterize(inputs, view.camera, settings, surfels.means.new_zeros(3))
            picture = render.color.cpu() + (1.0 - render.alpha.cpu())[..., None] * faded
            straight = (255.0 * picture.clamp(0, 1) + 0.5).to(torch.uint8).numpy()
            as_photo = np.stack(
                [manager.files["eval"].as_in_file(straight[..., c], index, border=0) for c in range(3)], axis=2
            )
            target = folder / _folder_of(name) / path
            write_whole(target, partial(Image.fromarray(as_photo).save, format="PNG"))
            if progress is not None:
                progress(index * len(parts) + number + 1, len(views) * len(parts))
    parser = manager.config.dataparser
    truth = Path(parser.data) / parser.ground_truth_path
    return Underlays(folder, len(views) * len(parts), truth / "silhouettes")


def _folder_of(name: str) -> str:
    """Return the object's name, by which evaluation finds silhouettes, or ``file_name`` if no folder can have it."""
    return name if "/" not in name and name not in (".", "..") else file_name(name)
