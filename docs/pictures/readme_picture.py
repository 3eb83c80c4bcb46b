"""The picture of README.md: a photo of the generated sample, its mask, and objects before and after refinement.

Run ``beags demo`` first; then ``python docs/pictures/readme_picture.py``. Another run, view or objects: ``--help``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from beags_plugin.export.frames import bounding_box
from beags_plugin.extraction.select import select_class
from beags_plugin.labels.class_ids import resize_nearest
from beags_plugin.pictures.cells import GAP, below, beside, cell, write_picture
from beags_plugin.pictures.contact_sheet import mask_overlay
from beags_plugin.pictures.objects import render_alone
from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings
from beags_plugin.plugin.objects.evaluate import EvaluatedRun
from beags_plugin.plugin.runs.read import training_viewpoints


@dataclass
class Picture:
    """A photo and its mask; then each object alone, before and after refinement."""

    load_config: Path = Path("outputs/demo/run/config.yml")
    """config.yml of a refined run."""
    output: Path = Path("docs/images/objects.jpg")
    """The file."""
    object: tuple[str, ...] = ("bowl", "ring")
    """Names of the objects."""
    view: int = 0
    """Which of the held-out views."""
    camera: tuple[int, ...] = (1, 6)
    """Which of the 12 cameras round each object."""
    height: int = 240
    """Pixels of each picture."""

    def write(self) -> None:
        run = EvaluatedRun(self.load_config)
        view = run.views[self.view]
        assert view.image is not None and view.visible is not None
        photo = (255 * view.image).round().byte().numpy()
        labels = resize_nearest(view.visible.numpy(), *photo.shape[:2])
        width = len(self.object) * (self.height + GAP) - GAP  # two of them are as wide as the line below
        size = (width, round(width * photo.shape[0] / photo.shape[1]))
        lines = [[cell(photo, size, "a photo"), cell(mask_overlay(photo, labels), size, "its mask")]]
        ids = {name: class_id for class_id, name in run.classes.items()}
        photos = training_viewpoints(run.stages["after"].config, run.settings, self.load_config).cameras
        for name, number in zip(self.object, self.camera, strict=True):
            parts = {
                stage: select_class(scene.surfels(), scene.members, ids[name])[0]
                for stage, scene in run.stages.items()
                if scene.assigned
            }
            stand = orbit_frame(*bounding_box(parts["after"]), photos)
            camera = orbit(stand, 12, self.height)[number]
            settings = orbit_settings(stand)
            lines.append(
                [
                    cell(
                        render_alone(part, camera, settings, run.rasterizer, "checker"),
                        (self.height, self.height),
                        f"{name}, {caption}",
                    )
                    for caption, part in zip(("classes alone", "refined"), parts.values(), strict=True)
                ]
            )
        picture = below([beside(lines[0]), beside([one for line in lines[1:] for one in line])])
        write_picture(self.output, np.ascontiguousarray(picture))


if __name__ == "__main__":
    tyro.cli(Picture).write()
