"""Where the files of a scene are, and cheap checks that they fit together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from beags_plugin.errors import UserError
from beags_plugin.rasterizers.interface import IGNORE

COLMAP_FOLDERS = ("sparse/0", "colmap/sparse/0", "sparse")


@dataclass(frozen=True)
class Source:
    """Where poses come from: ``file`` is the transforms .json, or the folder of the COLMAP model."""

    kind: Literal["transforms", "colmap"]
    root: Path
    file: Path


def find_source(data: Path, wanted: Literal["auto", "transforms", "colmap"] = "auto") -> Source:
    """Detect the scene's poses in ``data`` (a folder, or a transforms .json); transforms.json comes first.

    Raises ``UserError`` if there are none, or if the COLMAP model is incomplete.
    """
    if not data.exists():
        raise UserError(f"the data folder {data} does not exist: give --data the folder that holds the scene.")
    if data.is_file():
        if data.suffix != ".json":
            raise UserError(
                f"{data} is neither a folder nor a .json file: give --data the folder that holds the scene."
            )
        return Source("transforms", data.parent, data)
    if wanted != "colmap" and (data / "transforms.json").is_file():
        return Source("transforms", data, data / "transforms.json")
    if wanted != "transforms":
        for name in COLMAP_FOLDERS:
            if any(
                (data / name / f"{part}.{end}").is_file() for part in ("cameras", "images") for end in ("bin", "txt")
            ):
                return Source("colmap", data, _checked_model(data / name))
    looked_for = {
        "auto": "neither transforms.json nor a COLMAP model (sparse/0)",
        "transforms": "no transforms.json",
        "colmap": "no COLMAP model (sparse/0)",
    }[wanted]
    raise UserError(f"{data} holds {looked_for}: run ns-process-data or COLMAP first, or correct --data.")


def _checked_model(folder: Path) -> Path:
    end = "txt" if (folder / "cameras.txt").is_file() else "bin"  # the order in which nerfstudio looks
    for part in ("cameras", "images"):
        if not (folder / f"{part}.{end}").is_file():
            raise UserError(f"the COLMAP model {folder} lacks {part}.{end}: export the complete model again.")
    return folder


def has_points(model: Path) -> bool:
    """Whether a COLMAP model holds seed points (nerfstudio fails on an empty list of them)."""
    if (model / "points3D.bin").is_file():  # the order in which nerfstudio looks; the file starts with a 64-bit count
        return any((model / "points3D.bin").open("rb").read(8))
    text = model / "points3D.txt"
    return text.is_file() and any(line.strip() and not line.startswith("#") for line in text.open(encoding="utf-8"))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the file's header; raises ``UserError`` if it is no readable image."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return image.size
    except FileNotFoundError:
        raise UserError(f"the image {path} does not exist: restore it, or remove it from the poses.") from None
    except (UnidentifiedImageError, OSError) as error:
        raise UserError(f"{path} cannot be read as an image: replace it ({error}).") from error


def files_of_views(folder: Path, images: Sequence[Path], images_root: Path) -> list[Path | None]:
    """For each image its .png in ``folder``: at the image's path below ``images_root``, else by its stem, else None.

    Raises ``UserError`` if a stem that several images share would give them the same file.
    """
    if not folder.is_dir():
        return [None] * len(images)
    present = {path.relative_to(folder) for path in folder.rglob("*.png")}
    stems = Counter(image.stem for image in images)
    files: list[Path | None] = []
    for image in images:
        below = image.relative_to(images_root) if image.is_relative_to(images_root) else Path(image.name)
        if below.with_suffix(".png") in present:
            files.append(folder / below.with_suffix(".png"))
        elif Path(f"{image.stem}.png") not in present:
            files.append(None)
        elif stems[image.stem] > 1:
            raise UserError(
                f"{folder / image.stem}.png could belong to {stems[image.stem]} images called {image.stem}: "
                f"put it at the image's own path below {folder}."
            )
        else:
            files.append(folder / f"{image.stem}.png")
    return files


def check_same_size(masks: Sequence[Path | None], sizes: Sequence[tuple[int, int]]) -> None:
    """Raise ``UserError`` for the first mask that is not as large as its image, ``sizes`` (width, height)."""
    for mask, (width, height) in zip(masks, sizes, strict=True):
        if mask is not None and (found := image_size(mask)) != (width, height):
            raise UserError(
                f"the mask {mask} is {found[0]}x{found[1]} pixels but its image is {width}x{height}: "
                f"make the mask from the image at its full size."
            )


def read_class_names(classes_file: Path, masks: Sequence[Path], ignore_ids: Sequence[int]) -> dict[int, str]:
    """Names of the classes: of ``classes_file``, or ``class_<id>`` for the ids in the masks where it does not exist.

    Raises ``UserError`` if a mask holds an id that an existing ``classes_file`` does not name. Reads all masks once.
    """
    from beags_plugin.masks.classes import read_classes

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding a .png releases the interpreter
        ids_of_masks = list(pool.map(lambda mask: ids_in_mask(mask, ignore_ids), masks))
    present = sorted(set().union(*ids_of_masks))
    if not classes_file.is_file():
        return read_classes(None, present)
    classes = read_classes(classes_file)
    for mask, ids in zip(masks, ids_of_masks, strict=True):
        if unknown := sorted(ids - classes.keys()):
            raise UserError(
                f"the mask {mask} holds id {unknown[0]}, which {classes_file} does not name: "
                f"add it there, correct the mask, or list it in ignore_ids."
            )
    return classes


def ids_in_mask(mask: Path, ignore_ids: Sequence[int]) -> set[int]:
    """The class ids of an id image, without IGNORE."""
    from beags_plugin.masks.classes import read_class_map

    counts = np.bincount(read_class_map(mask, ignore_ids).ravel(), minlength=IGNORE + 1)
    return {int(i) for i in np.flatnonzero(counts) if i != IGNORE}


def split_views(stems: Sequence[str], interval: int, held_out: Sequence[str] = ()) -> tuple[list[int], list[int]]:
    """Indices of the training and of the evaluation views: every ``interval``-th from the first, and ``held_out``.

    Raises ``UserError`` if a held-out stem does not exist or if one side stays empty.
    """
    if unknown := sorted(set(held_out) - set(stems)):
        raise UserError(f"held_out names {unknown[0]!r}, but no image has that stem: correct the name.")
    out = {i for i, stem in enumerate(stems) if stem in held_out or (interval > 0 and i % interval == 0)}
    train = [i for i in range(len(stems)) if i not in out]
    evaluation = sorted(out) or train
    if not train:
        raise UserError(f"all {len(stems)} views are held out for evaluation: add views or change eval_interval.")
    return train, evaluation


def find_ground_truth(folder: Path, images: Sequence[Path], images_root: Path) -> dict | None:
    """Exact masks kept for evaluation only, or None where ``folder`` is absent.

    ``masks``: per view the path of the visible-id image or None. ``silhouettes``: object name to per view the path of
    its occlusion-free silhouette or None. ``seen``: likewise, the part of it that training photos show.
    """
    if not folder.is_dir():
        return None

    def per_object(kind: str) -> dict[str, list[Path | None]]:
        objects = sorted(path for path in (folder / kind).glob("*") if path.is_dir())
        return {path.name: files_of_views(path, images, images_root) for path in objects}

    masks = files_of_views(folder / "masks", images, images_root)
    return {"masks": masks, "silhouettes": per_object("silhouettes"), "seen": per_object("seen")}
