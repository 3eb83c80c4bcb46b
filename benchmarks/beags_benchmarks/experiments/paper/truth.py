"""``beags bench truth``: write downloaded masks of a scene where evaluation finds them."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from beags_benchmarks.experiments.paper.downloads import DownloadedObject, Scribbles
from beags_plugin.data.dataset import ColmapModel
from beags_plugin.data.files import image_size, same_proportions
from beags_plugin.data.layouts.llff import camera_names
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import UNTOLD, read_object_mask, write_mask
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.pasted import quoted
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.system.wording import amount, verb
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.scene_data import SceneData

PROMPTS = "prompts.json"


def import_truth(data: DataOptions, objects: Sequence[DownloadedObject], overwrite: bool = False) -> list[str]:
    """Write visible masks of a scene to ground_truth/visible/<object>/<photo>.png, and scribbles to prompts.json.

    Masks keep their size. data: names the scene. overwrite: replace existing files. Returns lines that report the
    files. Raises ``UserError``, before anything is written, if no photo has a mask's name, or proportions differ.
    """
    with contextlib.redirect_stdout(io.StringIO()):  # nerfstudio lists its splits
        parser = SceneData(data)
        scene, views = parser.posed_views()
        held_out = {views.images[index] for index in parser.views_of_split(views, "test")}
    photos = {image.stem: image for image in views.images}
    folder = scene.poses.images if isinstance(scene.poses, ColmapModel) else views.images[0].parent
    names = camera_names(scene.root, folder)

    def photo(camera: str) -> Path | None:
        return photos.get(names.get(camera, camera))

    truth, prompts = scene.root / data.ground_truth_path / "visible", scene.root / PROMPTS
    masks: dict[Path, np.ndarray] = {}
    lines = []
    for each in objects:
        absent = []
        for camera, file in each.masks.items():
            if (image := photo(camera)) is None:
                absent.append(camera)
                continue
            _check_proportions(file, image_size(file, "the mask"), image)
            mask = read_object_mask(file)
            masks[truth / each.name / f"{image.stem}.png"] = np.where(mask == IGNORE, UNTOLD, 255 * (mask == 1))
        if len(absent) == len(each.masks):
            raise UserError(
                f"no photo of {scene.root} is called {absent[0]}, as a mask of {each.name} is: give --images-path the "
                "photos with the camera's names, or write original_names.txt (docs/data.md)."
            )
        written = len(each.masks) - len(absent)
        lines.append(f"{each.name}: {amount(written, 'visible mask')} in {truth / each.name}")
        if absent:
            others, are = amount(len(absent), "mask"), verb(len(absent), "are")
            first = absent[0] if len(absent) == 1 else f"{absent[0]}, ..."
            lines.append(f"{each.name}: {others} of other photos {are} left out ({first}).")
    entries = []
    for index, each in enumerate(objects, start=1):
        if each.scribbles is not None and (image := photo(each.scribbles.view)) is not None:
            entries.append(_prompts(index, each.name, each.scribbles, image))
            if image in held_out:
                lines.append(
                    f"{each.name}: its scribbles are on {image.stem}, which is held out, so no mask may be made from "
                    f"it: prompt in another photo (correct {PROMPTS})."
                )
    there = [path for path in (*masks, *([prompts] if entries else [])) if path.exists()]
    if there and not overwrite:
        raise UserError(f"{there[0]} exists already: add --overwrite, or remove it.")
    with writing(truth):
        for path, mask in masks.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path, mask)
    if entries:
        write_text_atomically(json.dumps({"objects": entries}, indent=1) + "\n", prompts)
        lines.append(
            f"prompts of the scribbles: {prompts}\n"
            f"  beags masks make --data {quoted(scene.root)} --source sam2 --options prompts={quoted(prompts)}"
        )
    elif not any(each.scribbles for each in objects):
        lines.append("There are no scribbles, so no prompts are written.")
    else:
        lines.append("No photo of the scene has scribbles, so no prompts are written.")
    return lines


def _check_proportions(file: Path, size: tuple[int, int], image: Path) -> None:
    """Raise ``UserError`` if the proportions of a file differ from its photo's."""
    width, height = image_size(image)
    if not same_proportions((width, height), size):
        raise UserError(
            f"{file} is {size[0]}x{size[1]} pixels but the photo {image} is {width}x{height}: use files of one view."
        )


def _prompts(index: int, name: str, scribbles: Scribbles, image: Path) -> dict[str, Any]:
    """Return an object's entry of a prompts file, points in pixels of the photo."""
    _check_proportions(Path(f"scribbles/{name}"), scribbles.size, image)
    (width, height), (own_width, own_height) = image_size(image), scribbles.size

    def scaled(points: Sequence[tuple[float, float]]) -> list[list[float]]:
        return [[round(x * width / own_width, 1), round(y * height / own_height, 1)] for x, y in points]

    points = {"points": scaled(scribbles.inside), "outside": scaled(scribbles.outside)}
    return {"name": name, "id": index, "prompts": [{"view": image.stem, **points}]}
