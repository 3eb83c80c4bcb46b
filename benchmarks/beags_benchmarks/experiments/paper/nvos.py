"""``beags bench nvos``: NVOS's masks of a scene of LLFF as ground truth, and its scribbles as prompts for masks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beags_benchmarks.experiments.scenes import quiet
from beags_plugin.data.files import image_size, list_images, same_proportions
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.labels.classes import UNTOLD, read_object_mask, write_mask
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.pasted import quoted
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.system.wording import amount
from beags_plugin.views.data_options import DataOptions
from beags_plugin.views.scene_data import SceneData

POINTS = 10  # most points of each kind that replace the scribbles on an object, about as many as a user clicks
PROMPTS = "prompts.json"
_MASK = "_mask"


@dataclass(frozen=True)
class NvosObject:
    """An object of NVOS: its visible masks by the stem of the photo, and its scribbles as points if there are any.

    view: stem of the photo with the scribbles. size: (width, height) of the image that the points refer to. inside,
    outside: (x, y), pixels, on the object and beside it.
    """

    name: str
    masks: dict[str, Path]
    view: str = ""
    size: tuple[int, int] = (0, 0)
    inside: tuple[tuple[float, float], ...] = ()
    outside: tuple[tuple[float, float], ...] = ()


def read_nvos(folder: Path, scene: str) -> list[NvosObject]:
    """Read NVOS's objects of a scene of LLFF.

    folder: holds masks/<object>/<photo>_mask.png, scribbles/<object>/pos_*.png and neg_*.png (of any size in the
    photo's proportions), and reference_image/<object>/<photo>, the photo with the scribbles. An object's name is that
    of the scene, perhaps with an ending (horns_left). Raises ``UserError`` without masks, and for incomplete scribbles.
    """
    masks = folder / "masks"
    if not masks.is_dir():
        raise UserError(f"{folder} has no folder masks: give --nvos the folder that holds masks and scribbles.")
    names = sorted(path.name for path in masks.iterdir() if path.is_dir())
    own = [name for name in names if name == scene or name.startswith(f"{scene}_")]
    if not own:
        raise UserError(f"{masks} has no object of a scene {scene!r}: name the scene's folder as one of {names}.")
    objects = []
    for name in own:
        files = {path.stem.removesuffix(_MASK): path for path in sorted((masks / name).glob(f"*{_MASK}.png"))}
        if not files:
            raise UserError(f"{masks / name} holds no mask <photo>{_MASK}.png: restore the download.")
        objects.append(NvosObject(name, files, *_scribbles(folder, name)))
    return objects


def _scribbles(folder: Path, name: str) -> tuple[Any, ...]:
    """Return view, size, inside and outside of an object's scribbles; () if the download lacks them."""
    strokes, photos = folder / "scribbles" / name, list_images(folder / "reference_image" / name)
    inside, outside = (sorted(strokes.glob(f"{kind}_*.png")) for kind in ("pos", "neg"))
    if not inside or not photos:
        return ()
    sizes = {image_size(path, "the scribble") for path in (*inside, *outside)}
    if len(sizes) > 1 or len(photos) > 1:
        raise UserError(f"the scribbles in {strokes} differ in size, or are on several photos: restore the download.")
    return photos[0].stem, sizes.pop(), tuple(points_of(inside)), tuple(points_of(outside))


def points_of(files: list[Path]) -> Iterator[tuple[float, float]]:
    """Yield at most ``POINTS`` points (x, y) along the middle of scribbles, each as far as possible from the others.

    Points are in pixels from the corner of the image. The first is where the scribbles are broadest.
    """
    from scipy.ndimage import distance_transform_edt, maximum_filter

    if not files:
        return
    scribbled = np.stack([read_object_mask(path) == 1 for path in files]).any(axis=0)
    depth = np.asarray(distance_transform_edt(np.pad(scribbled, 1)))[1:-1, 1:-1]  # scribbles end at the image's border
    rows, columns = np.nonzero(scribbled & (depth == maximum_filter(depth, 3)))  # the middle line
    if not len(rows):
        return
    places = np.stack([columns, rows], axis=1) + 0.5
    distance = np.full(len(places), np.inf)  # squared, to the points so far
    chosen = int(np.argmax(depth[rows, columns]))
    for _ in range(min(POINTS, len(places))):
        x, y = places[chosen]
        yield float(x), float(y)
        distance = np.minimum(distance, ((places - places[chosen]) ** 2).sum(axis=1))
        chosen = int(np.argmax(distance))


def import_nvos(data: Path, nvos: Path, overwrite: bool = False) -> list[str]:
    """Write the visible masks of a scene to ground_truth/visible/<object>/<photo>.png, and scribbles to prompts.json.

    Masks keep their size. data: the scene's folder, whose name is the scene's. overwrite: replace existing files.
    Returns lines that report the files. Raises ``UserError``, before anything is written, if no photo has a mask's
    name, or proportions differ.
    """
    objects = read_nvos(nvos, data.resolve().name.lower())
    options = DataOptions(data=data, layout="llff", images_path=Path("images"))
    with quiet():
        scene, views = SceneData(options).posed_views()
    photos = {image.stem: image for image in views.images}
    masks: dict[Path, np.ndarray] = {}
    lines, entries = [], []
    for index, each in enumerate(objects, start=1):
        folder = scene.root / options.ground_truth_path / "visible" / each.name
        there = {stem: file for stem, file in each.masks.items() if stem in photos}
        if not there:
            raise UserError(
                f"no photo of {scene.root} is called {next(iter(each.masks))}, as a mask of {each.name} is."
            )
        for stem, file in there.items():
            _check_proportions(file, image_size(file, "the mask"), photos[stem])
            mask = read_object_mask(file)
            masks[folder / f"{stem}.png"] = np.where(mask == IGNORE, UNTOLD, 255 * (mask == 1))
        lines.append(f"{each.name}: {amount(len(there), 'visible mask')} in {folder}")
        if each.view in photos:
            entries.append(_prompts(index, each, photos[each.view]))
    prompts = scene.root / PROMPTS
    if not overwrite and (former := [path for path in (*masks, *([prompts] if entries else [])) if path.exists()]):
        raise UserError(f"{former[0]} exists already: add --overwrite, or remove it.")
    for path, mask in masks.items():
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path, mask)
    if not entries:
        return [*lines, "No photo of the scene has scribbles, so no prompts are written."]
    write_text_atomically(json.dumps({"objects": entries}, indent=1) + "\n", prompts)
    command = f"beags masks make --data {quoted(scene.root)} --source sam2 --options prompts={quoted(prompts)}"
    return [*lines, f"prompts of the scribbles: {prompts}\n  {command}"]


def _check_proportions(file: Path, size: tuple[int, int], image: Path) -> None:
    """Raise ``UserError`` if the proportions of a file differ from its photo's."""
    width, height = image_size(image)
    if not same_proportions((width, height), size):
        raise UserError(
            f"{file} is {size[0]}x{size[1]} pixels but the photo {image} is {width}x{height}: use files of one view."
        )


def _prompts(index: int, each: NvosObject, image: Path) -> dict[str, Any]:
    """Return an object's entry of a prompts file, points in pixels of the photo."""
    _check_proportions(Path(f"scribbles/{each.name}"), each.size, image)
    factors = np.array(image_size(image)) / each.size
    inside, outside = (
        [np.round(point * factors, 1).tolist() for point in points] for points in (each.inside, each.outside)
    )
    return {"name": each.name, "id": index, "prompts": [{"view": image.stem, "points": inside, "outside": outside}]}
