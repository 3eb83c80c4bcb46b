"""The picture of README.md: a scene in the view of a held-out photo, and an object cut out of it, before and after.

``python docs/pictures/readme_picture.py --load-config RUN/config.yml``; README's run is one of ``beags bench captures``
on the bear. Other views, objects or sides: ``--help``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from beags_plugin.cleaning.clean import clean
from beags_plugin.core.select import select_class
from beags_plugin.objects.evaluate import EvaluatedRun
from beags_plugin.objects.shown import shown_scene
from beags_plugin.pictures.cells import below, beside, cell, write_picture
from beags_plugin.pictures.objects import render_alone
from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings
from beags_plugin.surfaces.frames import bounding_box


@dataclass
class Picture:
    """A row for each stage: the object alone in that view, then from other sides."""

    load_config: Path
    """config.yml of a refined run."""
    output: Path = Path("docs/images/bear.jpg")
    """The file."""
    object: str = "object"
    """Name of the object."""
    view: int = 0
    """Which of the held-out views."""
    camera: tuple[int, ...] = (1, 4, 8)
    """Which of the 12 cameras round the object."""
    height: int = 300
    """Pixels of each picture."""

    def write(self) -> None:
        run = EvaluatedRun(self.load_config)
        view = run.views[self.view]
        of_photo = (math.ceil(self.height * view.camera.width / view.camera.height), self.height)
        whole = run.stages["after"].surfels()
        scene = render_alone(whole, view.camera, run.settings, run.rasterizer, "black")
        class_id = next(class_id for class_id, name in run.classes.items() if name == self.object)
        parts = {
            stage: select_class(scene.surfels(), scene.members, class_id)[0] for stage, scene in run.stages.items()
        }
        views = shown_scene(run.run).views
        parts["after"] = parts["after"][clean(parts["after"], class_id, views)[0]]
        photos = run.run.viewpoints.cameras
        stand = orbit_frame(*bounding_box(parts["after"]), photos)
        cameras = orbit(stand, 12, self.height)
        rows = []
        for caption, part in (("before", parts["before"]), ("after", parts["after"])):
            in_view = render_alone(part, view.camera, run.settings, run.rasterizer, "checker")
            sides = [
                render_alone(part, cameras[number], orbit_settings(stand), run.rasterizer, "checker")
                for number in self.camera
            ]
            cells = [cell(side, (self.height, self.height), caption) for side in sides]
            rows.append([cell(in_view, of_photo, caption), *cells])
        there = beside([cell(scene, of_photo, "the scene"), *(row[0] for row in rows)])
        picture = below([there, *(beside(row[1:]) for row in rows)])
        write_picture(self.output, np.ascontiguousarray(picture))


if __name__ == "__main__":
    tyro.cli(Picture).write()
