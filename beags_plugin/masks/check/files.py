"""Checks of each mask file by itself: missing, wrong size or type, ids without a name, objects in few views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beags_plugin.data.files import IMAGE_SUFFIXES, image_size
from beags_plugin.data.orientation import turned_note, upright_mask_error
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE, count_ids
from beags_plugin.labels.classes import palette_of, read_id_mask
from beags_plugin.labels.id_checks import check_ids, check_palettes
from beags_plugin.masks.check.issues import STOPS, Issue, named, percent
from beags_plugin.system.errors import UserError
from beags_plugin.system.pasted import command
from beags_plugin.system.wording import amount, verb

FEW_VIEWS = 3  # least views of an object: two are needed to outvote one
MOST_IDS = 256  # most ids in a file, and in a comparison of views, whose memory grows with their square
LARGE_IGNORE = 0.2  # least share of unlabelled pixels that a note reports
NO_MASKS = "training stops before its first step (beags-base needs no masks)"


@dataclass(frozen=True)
class MaskFiles:
    """The views of a scene and their masks.

    stems: names of the V images (``data.files.photo_names``). sizes: (width, height) of their files. masks: file of
    each view, or None. folder: of the masks. ignore_ids: see ``labels.classes.read_id_mask``. trained: False for
    held-out views. names: id to name from the user or the layout, or None. names_file: their file. photos: the files of
    the views.
    """

    stems: Sequence[str]
    sizes: Sequence[tuple[int, int]]
    masks: Sequence[Path | None]
    folder: Path
    ignore_ids: Sequence[int]
    trained: Sequence[bool]
    names: Mapping[int, str] | None
    names_file: Path
    photos: Sequence[Path] = ()

    def read(self, view: int) -> np.ndarray | None:
        """Read the class ids or IGNORE of a view, [H, W] uint16; None without a mask; raise ``UserError``."""
        path = self.masks[view]
        return None if path is None else read_id_mask(path, self.ignore_ids)

    def paths(self, views: Sequence[int]) -> str:
        """Name the masks of some views: the first by its path, the others by their paths below the folder."""
        masks = [path for view in views if (path := self.masks[view]) is not None]
        below = (path.relative_to(self.folder) if path.is_relative_to(self.folder) else path for path in masks[1:])
        return named([*masks[:1], *below])


@dataclass
class Coverage:
    """Pixels of each id in every view.

    ids: sorted, without IGNORE. pixels: [V, C]. ignored, size: [V], unlabelled and all pixels; 0 without a usable mask.
    usable: [V] bool, whether the view has a readable mask of the right size.
    """

    ids: list[int]
    pixels: np.ndarray
    ignored: np.ndarray
    size: np.ndarray
    usable: np.ndarray
    issues: list[Issue] = field(default_factory=list)


def check_files(files: MaskFiles, progress: Callable[[int, int], None] | None = None) -> Coverage:
    """Read every mask once, and report mistakes in files as issues."""
    views = len(files.stems)
    counts: list[dict[int, int] | None] = [None] * views
    issues: list[Issue] = []

    def look(view: int) -> dict[int, int] | Issue | None:
        path = files.masks[view]
        if path is None:
            return None
        try:
            size = image_size(path)  # read from the header, so that a far too large image is not decoded
            if size != tuple(files.sizes[view]):
                return _wrong_size(files, view, size)
            check_ids(path, labels := read_id_mask(path, files.ignore_ids))
        except UserError as error:
            return Issue("error", "type", str(error), STOPS, (files.stems[view],))
        ids, pixels = count_ids(labels)
        if len(ids) > MOST_IDS:
            return Issue(
                "error",
                "no id image",
                f"the mask {path} holds {len(ids)} different ids: this is no id image (a photo? depth?), replace it.",
                "training stops, or, without a classes.json, treats every value as an object",
                (files.stems[view],),
            )
        return dict(zip(ids.tolist(), pixels.tolist(), strict=True))

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding a .png releases the interpreter
        for view, found in enumerate(pool.map(look, range(views))):
            if isinstance(found, Issue):
                issues.append(found)
            else:
                counts[view] = found
            if progress:
                progress(view + 1, views)
        issues += _palettes(files, [view for view, found in enumerate(counts) if found is not None], pool)
    coverage = _coverage(counts)
    coverage.issues += issues
    coverage.issues += [*_missing(files), *_no_object(files, coverage), *_strays(files), *_names(files, coverage)]
    if any(files.masks) and (sentence := turned_note(files.photos)) is not None:
        coverage.issues.append(
            Issue("note", "stored turned", sentence, "upright masks would be misplaced in the photos, unnoticed")
        )
    coverage.issues += [*_few_views(files, coverage), *_unlabelled(files, coverage)]
    return coverage


def _palettes(files: MaskFiles, views: Sequence[int], pool: ThreadPoolExecutor) -> list[Issue]:
    masks = [path for view in views if (path := files.masks[view]) is not None]
    try:
        check_palettes(masks, list(pool.map(palette_of, masks)))
    except UserError as error:
        return [Issue("error", "type", str(error), STOPS)]
    return []


def _coverage(counts: Sequence[Mapping[int, int] | None]) -> Coverage:
    ids = sorted(set().union(*(found for found in counts if found)) - {IGNORE} | {BACKGROUND})
    pixels = np.array([[(found or {}).get(i, 0) for i in ids] for found in counts], np.int64).reshape(-1, len(ids))
    ignored = np.array([(found or {}).get(IGNORE, 0) for found in counts], np.int64)
    usable = np.array([found is not None for found in counts])
    return Coverage(ids, pixels, ignored, pixels.sum(1) + ignored, usable)


def _wrong_size(files: MaskFiles, view: int, found: tuple[int, ...]) -> Issue:
    width, height = files.sizes[view]
    sentence, mask = None, files.masks[view]
    if files.photos and mask is not None:
        sentence = upright_mask_error(mask, (found[0], found[1]), files.photos[view], (width, height))
    sentence = sentence or (
        f"the mask {mask} is {found[0]}x{found[1]} pixels but its image is {width}x{height}: "
        "make it from the image at its full size, or scale it by nearest neighbour."
    )
    return Issue("error", "size", sentence, STOPS, (files.stems[view],))


def _make(files: MaskFiles) -> str:
    """Return the command that makes masks of what stands out in a scene's photos."""
    scene = files.folder.parent if files.folder.name == "masks" else "SCENE"
    return command(["beags", "masks", "make", "--data", scene, "--source", "salient"])


def _missing(files: MaskFiles) -> Iterator[Issue]:
    trained = [view for view, used in enumerate(files.trained) if used]
    without = [files.stems[view] for view in trained if files.masks[view] is None]
    if without and len(without) == len(trained):
        yield Issue(
            "error",
            "missing",
            f"no training view has a mask in {files.folder}: put id images there, named as the images, or make "
            f"them with: {_make(files)}",
            NO_MASKS,
            tuple(without),
        )
    elif without:
        yield Issue(
            "warning",
            "missing",
            f"{len(without)} of {len(trained)} training views have no mask in {files.folder}: {named(without)}; "
            "add them, or leave it to reprojection.",
            f"{percent(len(without), len(trained))} of the views do not vote; reprojection labels them from the "
            "others, and with --pipeline.model.prepare.reprojection none no mask loss uses them",
            tuple(without),
        )


def _no_object(files: MaskFiles, coverage: Coverage) -> Iterator[Issue]:
    masks = np.asarray(files.trained, bool) & coverage.usable
    if masks.any() and not coverage.pixels[masks][:, np.asarray(coverage.ids) != BACKGROUND].any():
        yield Issue(
            "error",
            "no object",
            f"no mask of a training view in {files.folder} names an object, all are background or unlabelled: give "
            f"objects ids above 0, or make masks with: {_make(files)}",
            NO_MASKS,
        )


def _strays(files: MaskFiles) -> Iterator[Issue]:
    """Find images in the masks' folder that belong to no view."""
    images = (path for path in files.folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if others := sorted(set(images) - set(files.masks)):
        other_type = any(path.suffix.lower() != ".png" for path in others)
        why = "masks are .png files" if other_type else "no image with a pose has such a name"
        yield Issue(
            "warning",
            "unused",
            f"{amount(len(others), 'file')} in {files.folder} {verb(len(others), 'are')} not used "
            f"({named([path.name for path in others], 3)}), as {why}: give each the name of "
            "its image, as .png; those of photos without a pose may stay.",
            "training does not use them",
        )


def _names(files: MaskFiles, coverage: Coverage) -> Iterator[Issue]:
    """Find ids without a name, and names without a mask."""
    if files.names is None:
        return
    for column, class_id in enumerate(coverage.ids):
        views = np.flatnonzero(coverage.pixels[:, column])
        if class_id == BACKGROUND or class_id in files.names or not len(views):
            continue
        pixels = int(coverage.pixels[:, column].sum())
        unlabelled = ", or, if it means unlabelled, add: beags-data --ignore-ids 255" if class_id == 255 else ""
        yield Issue(
            "error",
            "unknown id",
            f"id {class_id} is in {amount(len(views), 'mask')}, the first {files.masks[views[0]]}, but not in "
            f"{files.names_file}: name it there or correct the masks{unlabelled}.",
            f"{STOPS}; the id covers {pixels} pixels ({percent(pixels, coverage.size.sum())})",
            tuple(files.stems[int(view)] for view in views),
        )
    absent = [f"{i} ({name})" for i, name in files.names.items() if i != BACKGROUND and i not in coverage.ids]
    if absent:
        yield Issue(
            "warning",
            "unused name",
            f"{files.names_file} names ids that no mask holds: {named(absent)}; remove them or correct the masks.",
            "these objects get no Gaussians and cannot be extracted",
        )


def _few_views(files: MaskFiles, coverage: Coverage) -> Iterator[Issue]:
    trained = np.asarray(files.trained, bool)
    for column, class_id in enumerate(coverage.ids):
        views = [int(view) for view in np.flatnonzero(trained & (coverage.pixels[:, column] > 0))]
        if class_id == BACKGROUND or len(views) >= FEW_VIEWS:
            continue
        name = (files.names or {}).get(class_id, f"class_{class_id}")
        pixels = int(coverage.pixels[views, column].sum())
        yield Issue(
            "warning",
            "few views",
            f"id {class_id} ({name}) is in {len(views)} of {int(trained.sum())} training views "
            f"({files.paths(views) or 'only held-out views'}), fewer than {FEW_VIEWS}: mask it in more views, or set "
            "it to 0 if it is a mistake.",
            f"its {pixels} pixels can hardly be checked by votes: sides that no mask shows go to other classes",
            tuple(files.stems[view] for view in views),
        )


def _unlabelled(files: MaskFiles, coverage: Coverage) -> Iterator[Issue]:
    total, ignored = int(coverage.size.sum()), int(coverage.ignored.sum())
    if total and ignored / total >= LARGE_IGNORE:
        most = [int(view) for view in np.argsort(-coverage.ignored, kind="stable") if coverage.ignored[view]]
        yield Issue(
            "note",
            "unlabelled",
            f"{percent(ignored, total)} of the masks' pixels are unlabelled, most in {files.paths(most[:3])}: fine if "
            "nobody knows what is there, else label them (background is 0).",
            f"{ignored} pixels do not vote, and boundary and silhouette loss ignore them",
        )
