"""The parts of the paper's data sets that are on disk, and where missing parts belong."""

from __future__ import annotations

import contextlib
import json
import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beags_benchmarks.experiments.paper.data_sets import PaperDataSet
from beags_benchmarks.experiments.scenes import SceneSize, TrialScene, quiet
from beags_plugin.data import LAYOUTS
from beags_plugin.data.files import image_size, list_images
from beags_plugin.system.digests import folder_digest
from beags_plugin.system.errors import UserError
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.views.quick import QUICK_PIXELS

TRUTH = "ground_truth"


@dataclass(frozen=True)
class Sizes:
    """Sizes of photos. downscale: divisor of the paper's sizes. quick: some 50,000 pixels instead."""

    downscale: float = 1.0
    quick: bool = False

    def factor(self, data_set: PaperDataSet, photo: Path) -> float:
        """Return the divisor of the sides of a photo's file."""
        width, height = image_size(photo)
        if self.quick:
            return max(1.0, float(math.ceil(math.sqrt(width * height / QUICK_PIXELS))))
        return self.downscale * (1.0 if data_set.width is None else max(1.0, width / data_set.width))


@dataclass(frozen=True)
class SceneOnDisk:
    """One scene of a data set.

    scene: the scene to train on, or None if the folder or a part that training needs is missing. missing: sentences on
    these parts and where they belong. notes: sentences on parts that only the scores lack. size: of the
    training views.
    """

    data_set: PaperDataSet
    name: str
    folder: Path
    scene: TrialScene | None = None
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    size: SceneSize = SceneSize(0, 0)


def find_scenes(
    data_sets: Sequence[PaperDataSet], root: Path, output: Path, sizes: Sizes, only: Sequence[str] = ()
) -> list[SceneOnDisk]:
    """Return every scene of the data sets, there or not; raises ``UserError`` if ``root`` is no folder.

    output: prompts are written there for scenes whose masks are missing. only: names of scenes; all if empty.
    """
    if not root.is_dir():
        raise UserError(f"the data root {root} is no folder: name the one that holds the folders of the data sets.")
    known = {scene for data_set in data_sets for scene in data_set.scenes}
    if unknown := sorted(set(only) - known):
        raise UserError(f"{unknown[0]!r} is no scene of these data sets: name some of {', '.join(sorted(known))}.")
    return [
        find_scene(data_set, name, data_set.folder(root) / name, output, sizes)
        for data_set in data_sets
        for name in data_set.scenes
        if not only or name in only
    ]


def find_scene(data_set: PaperDataSet, name: str, folder: Path, output: Path, sizes: Sizes) -> SceneOnDisk:
    """Return a scene with its parts on disk: photos, poses, masks, names, truth."""
    absent = SceneOnDisk(data_set, name, folder)
    if not folder.is_dir():
        return absent
    missing, notes = [], []
    photos = list_images(folder / data_set.images)
    if not photos:
        missing.append(f"the photos belong in {folder / data_set.images}")
    if lacks := LAYOUTS.get(data_set.layout)().missing(folder):
        missing.append(f"{folder} holds {lacks}, which the download has there")
    masks = data_set.masks
    options: dict[str, Any] = {"layout": data_set.layout, "images_path": data_set.images}
    if _has_masks(folder / masks.folder):
        options["masks_path"] = masks.folder
    elif masks.instead and _has_masks(folder / masks.instead):
        notes.append(
            f"trains on {folder / masks.instead} ({masks.instead_source}); the paper's belong in "
            f"{folder / masks.folder}: {_make_masks(absent, output)}"
        )
    else:
        missing.append(f"the masks to train on belong in {folder / masks.folder}: {_make_masks(absent, output)}")
    if missing:
        return _without(absent, missing)
    if data_set.eval_interval is not None:
        options["eval_interval"] = data_set.eval_interval
    if name in data_set.held_out:
        options["held_out"] = [data_set.held_out[name]]
    try:
        factor = sizes.factor(data_set, photos[0])
        digest = folder_digest(folder, without=folder / TRUTH)
        scene = TrialScene(f"{data_set.name}/{name}", folder.resolve(), factor, digest, options=options)
        held_out, size = _read(scene)
    except UserError as error:
        return _without(absent, [str(error)])
    if data_set.width is not None and not sizes.quick and (width := image_size(photos[0])[0]) < data_set.width:
        notes.append(f"the photos in {folder / data_set.images} are {width} pixels wide, not {data_set.width}")
    notes += _truth_notes(data_set, name, folder, held_out)
    return SceneOnDisk(data_set, name, folder, scene, (), tuple(notes), size)


def _without(scene: SceneOnDisk, missing: Sequence[str]) -> SceneOnDisk:
    return SceneOnDisk(scene.data_set, scene.name, scene.folder, missing=tuple(missing))


def _has_masks(folder: Path) -> bool:
    return any(folder.rglob("*.png"))


def _make_masks(scene: SceneOnDisk, output: Path) -> str:
    """Return the command that makes a scene's masks; writes the prompts of objects that are known by text."""
    masks, folder = scene.data_set.masks, scene.folder
    prompts = folder / "prompts.json"
    if masks.texts and (names := _texts(scene)):
        prompts = output / "prompts" / f"{scene.data_set.name}-{scene.name}.json"
        objects = [{"name": name, "text": name} for name in names]
        write_text_atomically(json.dumps({"objects": objects}, indent=1) + "\n", prompts)
    options = ["--data", str(folder), "--source", "sam2", "--options", f"prompts={prompts}"]
    return shlex.join(["beags", "masks", "make", *options])


def _texts(scene: SceneOnDisk) -> tuple[str, ...]:
    """Return the objects of a scene: those of its file, else the lines of 3D-OVS's classes.txt."""
    if names := scene.data_set.scenes[scene.name]:
        return names
    with contextlib.suppress(OSError, ValueError):
        lines = (scene.folder / "segmentations" / "classes.txt").read_text("utf8").splitlines()
        return tuple(line.strip() for line in lines if line.strip())
    return ()


def _read(scene: TrialScene) -> tuple[Mapping[str, Any], SceneSize]:
    """Return the metadata of the held-out views and the size of the training views."""
    parser = scene.parser()
    parser.downscale_factor = scene.downscale
    with quiet():
        loader = parser.setup()
        held_out, training = (loader.get_dataparser_outputs(split) for split in ("test", "train"))
    return held_out.metadata, SceneSize.of(training)


def _truth_notes(data_set: PaperDataSet, name: str, folder: Path, held_out: Mapping[str, Any]) -> list[str]:
    """Return sentences on what the scores of a scene lack: names, visible masks, silhouettes."""
    notes = []
    classes = [each for class_id, each in held_out["classes"].items() if class_id != 0]
    wanted = list(data_set.scenes[name]) or classes
    if unnamed := [each for each in wanted if each not in classes]:
        names = ", ".join(map(repr, unnamed))
        notes.append(f"no class is called {names}: name the ids of the masks in {folder / 'classes.json'}")
    elif any(each == f"class_{class_id}" for class_id, each in held_out["classes"].items()):
        notes.append(f"the names of the ids of the masks belong in {folder / 'classes.json'}")
    wanted = [each for each in wanted if each in classes]  # others cannot be scored
    truth = held_out["ground_truth"] or {"masks": [], "visible": {}, "silhouettes": {}}
    own = held_out["no_truth"] is None and not truth["visible"] and any(held_out["mask_filenames"])
    visible = {each for each, files in truth["visible"].items() if any(files)}
    if not (any(truth["masks"]) or own) and (lacking := [each for each in wanted if each not in visible]):
        get = f": {data_set.truth.get.format(scene=shlex.quote(str(folder)))}" if data_set.truth.get else ""
        notes.append(f"visible masks of {_listed(lacking)} belong in {folder / data_set.truth.visible}{get}")
    traced = {each for each, files in truth["silhouettes"].items() if any(files)}
    if lacking := [each for each in wanted if each not in traced]:
        notes.append(
            f"silhouettes of {_listed(lacking)} belong in {folder / TRUTH / 'silhouettes'}/<object>/<photo>.png, white "
            "on black: without, extracted objects are compared with visible masks"
        )
    return notes


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
