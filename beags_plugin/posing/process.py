"""From a folder of photos or a video to a scene with poses; what was computed is kept, and a second call goes on."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from beags_plugin.posing.features import add_features, coarse_descriptors
from beags_plugin.posing.files import TRANSFORMS, write_scene
from beags_plugin.posing.mapping import match, place, refine
from beags_plugin.posing.pairs import COARSE, choose_pairs, likeness
from beags_plugin.posing.photos import FEWEST, Look, Photo, blurred, find_photos, repeated, take_photos
from beags_plugin.posing.video import VIDEO_SUFFIXES, take_frames
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.progress import Bar
from beags_plugin.system.whole_files import write_text_atomically

REPORT = "poses.json"
VERSION = 1  # of what is kept; another is computed anew
WORK = Path("colmap")
SHARE = 0.8  # of the photos; where fewer have a pose, a sentence says what to do
NAMED = 4  # photos in a sentence


@dataclass
class Posed:
    """What was found: photos with poses of all photos, their cameras and points, and sentences for the user."""

    photos: int
    registered: int
    reprojection_error: float
    points: int
    cameras: int
    without_pose: list[str]
    groups: list[int]
    notes: list[str]

    def summary(self) -> str:
        """Return the figures as one line."""
        return (
            f"{self.registered} of {self.photos} photos have poses, reprojection error {self.reprojection_error:.2f} "
            f"pixels, {self.points} points, {self.cameras} camera{'s' if self.cameras > 1 else ''}"
        )


def process(data: Path, output: Path, bar: Bar) -> tuple[Posed, Any]:
    """Find the poses of photos and write them into ``output``; returns the report and pycolmap's reconstruction.

    Raises ``UserError`` where the photos cannot be used, or fewer than three of them fit together.
    """
    import pycolmap

    if (output / TRANSFORMS).exists() and not (output / REPORT).exists():
        raise UserError(f"{output / TRANSFORMS} holds poses of another program: give another --output-dir.")
    video = data.is_file() and data.suffix.lower() in VIDEO_SUFFIXES
    if data.is_file() and not video:
        raise UserError(
            f"{data} is no video that is known by its name ({', '.join(VIDEO_SUFFIXES)}): give a folder of photos."
        )
    found = [] if video else find_photos(data)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    if video:
        found = take_frames(data, output / WORK / "frames", bar)
    with bar("photos") as progress:
        photos = take_photos(found, output / "images", progress)
    database = output / WORK / "database.db"
    with writing(output):
        known = _keep_or_clear(output / WORK, photos)
    with bar("features") as progress:
        opened: Any = pycolmap.Database.open(database)
        looks = add_features(opened, photos, progress)
        ids = [opened.read_image_with_name(photo.path.name).image_id for photo in photos]
        coarse = [coarse_descriptors(opened, image_id, COARSE) for image_id in ids]
        opened.close()
    _remember(output / WORK, photos)
    with bar("pairs") as progress:
        pairs = choose_pairs(likeness(coarse, progress))
    names = [photo.path.name for photo in photos]
    with bar("matches") as progress:
        match(database, names, pairs, progress)
    model, groups = _model(output, database, photos, known, bar)
    report = _report(photos, looks, model, groups)
    write_scene(output, model)
    write_text_atomically(json.dumps(asdict(report), indent=1) + "\n", output / REPORT)
    return report, model


def _model(output: Path, database: Path, photos: list[Photo], known: bool, bar: Bar) -> tuple[Any, list[list[str]]]:
    """Return the refined reconstruction of the largest group of photos, and the names of every group."""
    import pycolmap

    kept, groups_file = output / WORK / "refined", output / WORK / "groups.json"
    if known and groups_file.is_file():
        return pycolmap.Reconstruction(kept), json.loads(groups_file.read_text(encoding="utf-8"))
    work = output / WORK / "mapping"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    with bar("poses") as progress:
        models = place(database, output / "images", work, len(photos), progress)
    shutil.rmtree(work)
    if not models:
        raise UserError(
            f"none of the {len(photos)} photos fit together: take more of them, closer to each other, of a scene that "
            "has texture and stands still."
        )
    models[0] = refine(models[0])
    with writing(output):
        kept.mkdir(exist_ok=True)
        models[0].write(kept)
    groups = [sorted(model.images[image_id].name for image_id in model.reg_image_ids()) for model in models]
    write_text_atomically(json.dumps(groups) + "\n", groups_file)
    return models[0], groups


def _keep_or_clear(work: Path, photos: list[Photo]) -> bool:
    """Return whether just these photos were posed before; remove what belongs to others."""
    now = _content(photos)
    try:
        before = json.loads((work / "photos.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if before == now:
        return True
    work.mkdir(parents=True, exist_ok=True)
    for path in (work / "groups.json", work / "photos.json"):
        path.unlink(missing_ok=True)
    if isinstance(before, dict) and before.items() <= now.items():
        return False  # photos were added; their features and matches are too
    (work / "database.db").unlink(missing_ok=True)
    return False


def _remember(work: Path, photos: list[Photo]) -> None:
    write_text_atomically(json.dumps(_content(photos), indent=1) + "\n", work / "photos.json")


def _content(photos: list[Photo]) -> dict[str, Any]:
    return {"version": VERSION, **{photo.path.name: photo.digest for photo in photos}}


def _report(photos: list[Photo], looks: list[Look], model: Any, groups: list[list[str]]) -> Posed:
    names = [photo.path.name for photo in photos]
    without = sorted(set(names) - set(groups[0]))
    notes = []
    if found := blurred(looks):
        notes.append(f"{_named(names, found)} look blurred beside their neighbours: leave out those that are.")
    if found := repeated(looks):
        notes.append(f"{_named(names, found)} show the same as an earlier photo: leave them out.")
    sizes = sorted({(photo.width, photo.height) for photo in photos})
    if {size[::-1] for size in sizes} == set(sizes) and len(sizes) == 2:
        notes.append("Some photos are portrait and some landscape: each kind got a camera of its own.")
    elif len(sizes) > 1:
        listed = ", ".join(f"{width}x{height}" for width, height in sizes[:NAMED])
        notes.append(
            f"The photos have {len(sizes)} sizes ({listed}), and each got a camera of its own: use one size and zoom."
        )
    if len(groups) > 1 and len(groups[1]) >= FEWEST:
        notes.append(
            f"The photos fall into groups of {', '.join(str(len(group)) for group in groups)} that share no points, "
            f"and the largest was kept: add photos between {groups[0][0]} and {groups[1][0]}."
        )
    elif len(groups[0]) < SHARE * len(photos):
        lost = [names.index(name) for name in without]
        notes.append(
            f"{_named(names, lost)} have no pose, too few of their points are in other photos: take photos between "
            "them and the rest."
        )
    return Posed(
        len(photos), len(groups[0]), model.compute_mean_reprojection_error(), model.num_points3D(),
        len({model.images[image_id].camera_id for image_id in model.reg_image_ids()}), without,
        [len(group) for group in groups], notes,
    )  # fmt: skip


def _named(names: list[str], which: list[int]) -> str:
    shown = ", ".join(names[index] for index in which[:NAMED])
    return shown if len(which) <= NAMED else f"{shown} and {len(which) - NAMED} more"
