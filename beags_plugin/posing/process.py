"""Turn a folder of photos or a video into a scene with poses; a second call continues from saved results."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from beags_plugin.data.files import list_images
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.posing.features import add_features, coarse_descriptors, forget
from beags_plugin.posing.files import MODEL, POINTS, TRANSFORMS, write_scene
from beags_plugin.posing.mapping import at_photo_size, color_points, match, place, refine
from beags_plugin.posing.pairs import COARSE, choose_pairs, likeness
from beags_plugin.posing.photos import (
    FEWEST,
    Look,
    Photo,
    blurred,
    check_photos,
    copy_photos,
    find_photos,
    repeated,
    with_masks,
)
from beags_plugin.posing.video import find_frames, is_video, write_frames
from beags_plugin.system.errors import UserError, writing
from beags_plugin.system.lock import run_lock
from beags_plugin.system.memory import trim_memory
from beags_plugin.system.progress import Bar
from beags_plugin.system.whole_files import write_text_atomically
from beags_plugin.system.wording import amount, verb

REPORT = "poses.json"
VERSION = 2  # version of the saved state; a state of another version is discarded
WORK = Path("colmap")
DATABASE = "database.db"
KEPT = "kept.json"
SHARE = 0.8  # share of photos with a pose below which a note says what to do
NAMED = 4  # photos named in a sentence


class NothingFits(UserError):
    """No three of the photos fit together."""


@dataclass
class Posed:
    """Result for the user: numbers of photos, of photos with poses, points and cameras, and notes."""

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
            f"pixels, {self.points} points, {amount(self.cameras, 'camera')}"
        )


@dataclass
class Kept:
    """State that a second call continues from, beside COLMAP's database.

    photos: name to digest of the photos whose features the database holds. paired: names of the photos for which
    ``pairs`` of indices were chosen. posed: name to digest of the photos behind transforms.json.
    """

    version: int = VERSION
    photos: dict[str, str] = field(default_factory=dict)
    paired: list[str] = field(default_factory=list)
    pairs: list[tuple[int, int]] = field(default_factory=list)
    posed: dict[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, work: Path) -> Kept:
        """Return the state saved in a folder; without a valid one, remove the folder's database."""
        try:
            kept = cls(**json.loads((work / KEPT).read_text(encoding="utf-8")))
            if kept.version == VERSION:
                return kept
        except (OSError, ValueError, TypeError):
            pass
        (work / DATABASE).unlink(missing_ok=True)
        return cls()

    def write(self, work: Path) -> None:
        """Save the state; called before the work that it describes."""
        write_text_atomically(json.dumps(asdict(self)) + "\n", work / KEPT)


def process(
    data: Path, output: Path, bar: Bar, masks: Path | None = None, ignore_ids: tuple[int, ...] = ()
) -> tuple[Posed, Any]:
    """Find the poses of photos and write them into ``output``; returns the report and pycolmap's reconstruction.

    masks: folder of id images <photo>.png; only features on their objects are used. ignore_ids: see ``Photo``.
    Raises ``UserError`` where the photos cannot be used, ``NothingFits`` where fewer than three fit together.
    """
    if find_spec("pycolmap") is None:
        raise UserError("the library pycolmap is not installed: pip install pycolmap.")
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    images, work = output / "images", output / WORK
    if (output / TRANSFORMS).exists() and not ((output / REPORT).exists() or (work / KEPT).exists()):
        raise UserError(f"{output / TRANSFORMS} holds poses of another program: give another --output-dir.")
    video = is_video(data)
    if ignore_ids and masks is None:
        raise UserError("ignore_ids says what ids in masks mean, but there are no masks: add --masks, or leave it out.")
    if wrong := [index for index in ignore_ids if not 0 <= index <= IGNORE]:
        raise UserError(f"ignore_ids holds {wrong[0]}: ids are whole numbers in 0..{IGNORE}.")

    def restricted(photos: list[Photo]) -> list[Photo]:
        return photos if masks is None else with_masks(photos, masks, ignore_ids)

    if masks is not None and not masks.is_dir():
        raise UserError(f"{masks} is no folder: give --masks that of the id images.")
    files = find_frames(data, work / "frames", bar) if video else find_photos(data)
    if list_images(images) and not (work / KEPT).exists() and files[0].parent.resolve() != images.resolve():
        raise UserError(f"{images} holds photos already: give another --output-dir, or these as --data.")
    photos = [] if video else restricted(check_photos(files, images, bar))
    lock = run_lock(output, "being given poses")
    try:
        if video:
            write_frames(data, files, bar)
            photos = restricted(check_photos(files, images, bar))
        with writing(output):
            return _process(photos, output, bar)
    finally:
        lock.release()


def _process(photos: list[Photo], output: Path, bar: Bar) -> tuple[Posed, Any]:
    """Find poses in a folder that this process has locked."""
    import pycolmap

    work, masked = output / WORK, any(photo.mask for photo in photos)
    work.mkdir(parents=True, exist_ok=True)
    kept, names = Kept.read(work), [photo.path.name for photo in photos]
    content = {photo.path.name: photo.digest for photo in photos}
    if kept.posed == content and all((output / part).exists() for part in (TRANSFORMS, POINTS, MODEL, REPORT)):
        report = json.loads((output / REPORT).read_text(encoding="utf-8"))
        return Posed(**report), pycolmap.Reconstruction(output / MODEL)
    changed = [photo for photo in photos if kept.photos.get(photo.path.name, photo.digest) != photo.digest]
    database: Any = pycolmap.Database.open(work / DATABASE)
    forget(database, changed)
    for photo in changed:
        if photo.source.resolve() != photo.path.resolve():
            photo.path.unlink(missing_ok=True)
    if photos[0].source.resolve() != photos[0].path.resolve():
        for name in kept.photos.keys() - content.keys():  # photos that the user has left out since
            (output / "images" / name).unlink(missing_ok=True)
    if changed or kept.paired != names:
        kept.paired, kept.pairs = [], []
    kept.photos, kept.posed = {**kept.photos, **content}, {}
    kept.write(work)
    copy_photos(photos, bar)
    with bar("features") as progress:
        looks = add_features(database, photos, progress)
    trim_memory()  # The pyramids of two large photos take 0.7 GB and more.
    if not kept.paired:
        with bar("pairs") as progress:
            ids = [database.read_image_with_name(photo.key).image_id for photo in photos]
            coarse = [coarse_descriptors(database, image_id, COARSE) for image_id in ids]
            kept.paired, kept.pairs = names, choose_pairs(likeness(coarse, progress))
        kept.write(work)
    database.close()
    keys = [photo.key for photo in photos]
    with bar("matches") as progress:
        match(work / DATABASE, keys, kept.pairs, progress)
    with bar("poses") as progress, TemporaryDirectory() as folder:
        models = place(work / DATABASE, Path(folder), keys, progress)
    if not models:
        raise NothingFits(
            f"none of the {len(photos)} photos fit together: take more of them, closer to each other, of a scene that "
            "has texture and stands still"
            + ("." if masked else "; if the thing turned before a room that stands, give --masks of the thing.")
        )
    with bar("lens") as progress:
        model = refine(models[0], progress)
    at_photo_size(model, {photo.path.name: (photo.width, photo.height) for photo in photos})
    color_points(model, output / "images")
    groups = [sorted(each.images[image_id].name for image_id in each.reg_image_ids()) for each in models]
    report = _report(photos, looks, model, groups)
    write_scene(output, model)
    write_text_atomically(json.dumps(asdict(report), indent=1) + "\n", output / REPORT)
    kept.posed = content
    kept.write(work)
    return report, model


def _report(photos: list[Photo], looks: list[Look], model: Any, groups: list[list[str]]) -> Posed:
    names = [photo.path.name for photo in photos]
    without = sorted(set(names) - set(groups[0]))
    notes = []
    if places := blurred(looks):
        look, those = verb(len(places), "look"), "it out if it is" if len(places) == 1 else "out those that are"
        notes.append(f"{_named(names, places)} {look} blurred beside other photos: leave {those}.")
    if places := repeated(looks):
        show, them = verb(len(places), "show"), "it" if len(places) == 1 else "them"
        notes.append(f"{_named(names, places)} {show} the same as an earlier photo: leave {them} out.")
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
            f"{_named(names, lost)} {verb(len(lost), 'have')} no pose, as other photos show too few of the same "
            "points: take photos in between."
        )
    return Posed(
        len(photos), len(groups[0]), model.compute_mean_reprojection_error(), model.num_points3D(),
        len({model.images[image_id].camera_id for image_id in model.reg_image_ids()}), without,
        [len(group) for group in groups], notes,
    )  # fmt: skip


def _named(names: list[str], which: list[int]) -> str:
    first = ", ".join(names[index] for index in which[:NAMED])
    return first if len(which) <= NAMED else f"{first} and {len(which) - NAMED} more"
