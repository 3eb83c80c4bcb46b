"""Exact masks that only evaluation uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypedDict, cast

from beags_plugin.data.dataset import Dataset, FilesOfObject
from beags_plugin.data.files import files_of_views
from beags_plugin.system.wording import verb

FilesPerView = list[Path | None]
OF_OBJECTS = ("visible", "silhouettes")
"""Kinds of ground truth with a folder of files for each object."""


class GroundTruth(TypedDict):
    """Files of exact masks, one or None per view.

    masks: id images. The others map an object's name to its files. visible: binary masks of its visible part.
    silhouettes: of the whole object, without occlusion.
    """

    masks: FilesPerView
    visible: dict[str, FilesPerView]
    silhouettes: dict[str, FilesPerView]


def of_views(truth: GroundTruth, chosen: Sequence[int]) -> GroundTruth:
    """Return the ground truth of some views."""
    of_objects = {
        kind: {name: [files[i] for i in chosen] for name, files in truth[kind].items()} for kind in OF_OBJECTS
    }
    return cast(GroundTruth, {"masks": [truth["masks"][i] for i in chosen], **of_objects})


def find_ground_truth(dataset: Dataset, folder: Path, images: Sequence[Path], images_root: Path) -> GroundTruth | None:
    """Find the exact masks in ``folder`` and of the layout; None without any.

    ``folder`` holds masks/<stem>.png, and <kind>/<object>/<stem>.png for the other kinds; these take precedence over
    files of the layout.
    """
    if not (folder.is_dir() or dataset.visible):
        return None

    def per_object(kind: str, own: Mapping[str, FilesOfObject]) -> dict[str, FilesPerView]:
        files_of = {name: [files.get(image.stem) for image in images] for name, files in own.items()}
        for path in sorted(path for path in (folder / kind).glob("*") if path.is_dir()):
            better = files_of_views(path, images, images_root)
            former = files_of.get(path.name, [None] * len(images))
            files_of[path.name] = [mask or other for mask, other in zip(better, former, strict=True)]
        return files_of

    of_objects = {kind: per_object(kind, dataset.visible if kind == "visible" else {}) for kind in OF_OBJECTS}
    return cast(GroundTruth, {"masks": files_of_views(folder / "masks", images, images_root), **of_objects})


def stray_note(folder: Path, images: Sequence[Path], images_root: Path) -> str | None:
    """Return a sentence on the files in ``folder`` that have the name of no image; None without such files.

    images: with a pose; ``files_of_views`` finds the files by their names.
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
    have, do = verb(len(strays), "have"), verb(len(strays), "do")
    return (
        f"{len(strays)} of the {len(present)} files in {folder} {have} the name of no photo that has a pose, and {do} "
        f"not count, {strays[0].relative_to(folder)} among them: name them as their photos, or remove them."
    )
