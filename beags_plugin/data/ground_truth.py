"""Exact masks and pictures kept for evaluation only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict

from beags_plugin.data.dataset import Dataset, FilesOfObject
from beags_plugin.data.files import files_of_views

FilesPerView = list[Path | None]
OF_OBJECTS = ("visible", "silhouettes", "seen", "removed", "removed_shown")
"""Folders of exact masks and pictures with a folder for each object."""


class GroundTruth(TypedDict):
    """Files of exact masks and pictures, one or None per view.

    masks: id images. visible, silhouettes, seen: object name to binary masks of its visible part, without occlusion,
    and of the part of the silhouette that training photos show. removed: to pictures without the object;
    removed_shown: to the part of the silhouette where these show surface that training photos show.
    """

    masks: FilesPerView
    visible: dict[str, FilesPerView]
    silhouettes: dict[str, FilesPerView]
    seen: dict[str, FilesPerView]
    removed: dict[str, FilesPerView]
    removed_shown: dict[str, FilesPerView]


def of_views(truth: GroundTruth, chosen: Sequence[int]) -> GroundTruth:
    """Return the ground truth of some views."""

    def each(files: dict[str, FilesPerView]) -> dict[str, FilesPerView]:
        return {name: [of_object[i] for i in chosen] for name, of_object in files.items()}

    return GroundTruth(
        masks=[truth["masks"][i] for i in chosen],
        visible=each(truth["visible"]),
        silhouettes=each(truth["silhouettes"]),
        seen=each(truth["seen"]),
        removed=each(truth["removed"]),
        removed_shown=each(truth["removed_shown"]),
    )


def find_ground_truth(dataset: Dataset, folder: Path, images: Sequence[Path], images_root: Path) -> GroundTruth | None:
    """Find the exact masks and pictures in ``folder`` and those of the layout; None without any.

    ``folder`` holds masks/<stem>.png, and <kind>/<object>/<stem>.png for the other kinds.
    """
    if not (folder.is_dir() or dataset.visible or dataset.silhouettes):
        return None

    def per_object(kind: str, own: Mapping[str, FilesOfObject]) -> dict[str, FilesPerView]:
        found = {name: [files.get(image.stem) for image in images] for name, files in own.items()}
        for path in sorted(path for path in (folder / kind).glob("*") if path.is_dir()):
            better = files_of_views(path, images, images_root)
            given = found.get(path.name, [None] * len(images))
            found[path.name] = [mask or former for mask, former in zip(better, given, strict=True)]
        return found

    return GroundTruth(
        masks=files_of_views(folder / "masks", images, images_root),
        visible=per_object("visible", dataset.visible),
        silhouettes=per_object("silhouettes", dataset.silhouettes),
        seen=per_object("seen", {}),
        removed=per_object("removed", {}),
        removed_shown=per_object("removed_shown", {}),
    )


def stray_note(folder: Path, images: Sequence[Path], images_root: Path) -> str | None:
    """Return a sentence about the files in ``folder`` that have the name of no image; None without such files.

    images: those with a pose, by whose names ``files_of_views`` finds the files.
    """
    places = [folder / "masks", *(path for kind in OF_OBJECTS for path in (folder / kind).glob("*") if path.is_dir())]
    present = {path for place in places for path in place.rglob("*.png")}
    strays = sorted(present - {path for place in places for path in files_of_views(place, images, images_root)})
    if not strays:
        return None
    if len(strays) == len(present):
        return (
            f"No exact mask in {folder} has the name of a photo here ({images[0].stem}.png, ...), so none counts: name "
            f"them as their photos, or remove them if they are of another scene."
        )
    return (
        f"{len(strays)} of the {len(present)} files in {folder} have the name of no photo that has a pose, and do not "
        f"count, {strays[0].relative_to(folder)} among them: name them as their photos, or remove them."
    )
