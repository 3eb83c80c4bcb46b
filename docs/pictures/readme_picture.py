"""The picture of README.md: a scene in the view of a held-out photo, and an object cut out of it, before and after.

``python docs/pictures/readme_picture.py --load-config RUN/config.yml``; README's run is one of ``beags bench captures``
on the bear. Other views, objects or sides: ``--help``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from beags_plugin.cleaning.clean import clean
from beags_plugin.core.select import select_class
from beags_plugin.objects.evaluate import EvaluatedRun
from beags_plugin.objects.shown import shown_scene
from beags_plugin.pictures.cells import GAP, below, beside, cell, write_picture
from beags_plugin.pictures.objects import render_alone
from beags_plugin.pictures.orbit import orbit, orbit_frame, orbit_settings
from beags_plugin.surfaces.frames import bounding_box

SHARE = 0.88  # part of the cameras' picture round the object that a cell shows


@dataclass
class Picture:
    """Above, the scene in that view and the object alone in it, before and after; below, the same from other sides."""

    load_config: Path
    """config.yml of a refined run."""
    output: Path = Path("docs/images/bear.jpg")
    """The file."""
    object: str = "object"
    """Name of the object."""
    view: int = 0
    """Which of the held-out views."""
    camera: tuple[int, int] = (4, 8)
    """Which of the 12 cameras round the object."""
    size: tuple[int, int] = (300, 240)
    """Width and height in pixels of the pictures above, which are cut out of the middle of the photo."""

    def write(self) -> None:
        run = EvaluatedRun(self.load_config)
        view = run.views[self.view]
        whole = run.stages["after"].surfels()
        scene = render_alone(whole, view.camera, run.settings, run.rasterizer, "black")
        class_id = next(class_id for class_id, name in run.classes.items() if name == self.object)
        parts, views = {}, shown_scene(run.run).views
        for stage, saved in run.stages.items():
            part, _ = select_class(saved.surfels(), saved.members, class_id)
            parts[stage] = part[clean(part, class_id, views)[0]]
        photos = run.run.viewpoints.cameras
        stand = orbit_frame(*bounding_box(parts["after"]), photos)
        side = (3 * self.size[0] - GAP) // 4
        cameras = orbit(stand, 12, round(side / SHARE))
        settings = orbit_settings(stand)
        above, beneath = [cell(middle(scene, self.size), self.size, "the scene")], []
        for stage, part in parts.items():
            in_view = render_alone(part, view.camera, run.settings, run.rasterizer, "checker")
            above.append(cell(middle(in_view, self.size), self.size, stage))
        for number in self.camera:
            for stage, part in parts.items():
                image = render_alone(part, cameras[number], settings, run.rasterizer, "checker")
                beneath.append(cell(cropped(image, (side, 3 * side // 4)), (side, 3 * side // 4), stage))
        write_picture(self.output, np.ascontiguousarray(below([beside(above), beside(beneath)])))


def cropped(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the middle of an image [H, W, 3], ``size`` (width, height) pixels large."""
    left, top = ((have - want) // 2 for have, want in zip(image.shape[1::-1], size, strict=True))
    return image[top : top + size[1], left : left + size[0]]


def middle(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return the largest part of an image's middle that has the proportions of ``size`` (width, height)."""
    scale = min(image.shape[1] / size[0], image.shape[0] / size[1])
    return cropped(image, (int(size[0] * scale), int(size[1] * scale)))


if __name__ == "__main__":
    tyro.cli(Picture).write()
