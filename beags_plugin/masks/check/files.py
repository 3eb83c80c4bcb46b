"""Checks of the mask files alone: missing, of the wrong size or type, ids without a name, objects in few views."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from beags_plugin.data.files import IMAGE_SUFFIXES, image_size
from beags_plugin.labels.class_ids import BACKGROUND, IGNORE
from beags_plugin.labels.classes import read_mask
from beags_plugin.masks.check.issues import STOPS, Issue, named, percent
from beags_plugin.system.errors import UserError

FEW_VIEWS = 3  # an object needs two other views to outvote one
MOST_IDS = 256  # in one file, or compared between views, which takes memory with their square
LARGE_IGNORE = 0.2  # share of unlabelled pixels that is worth a word


@dataclass(frozen=True)
class MaskFiles:
    """The views of a scene and the mask of each.

    stems: names of the V images (``data.files.photo_names``); sizes: (width, height) of their files; masks: file or
    None. folder: where masks are looked for. kind, ignore_ids: see ``labels.classes.read_mask``. trained: whether each
    view is trained on. names: id to name where the user or the layout gave names, else None; names_file: where they
    stand.
    """

    stems: Sequence[str]
    sizes: Sequence[tuple[int, int]]
    masks: Sequence[Path | None]
    folder: Path
    kind: str
    ignore_ids: Sequence[int]
    trained: Sequence[bool]
    names: Mapping[int, str] | None
    names_file: Path

    def read(self, view: int) -> np.ndarray | None:
        """[H, W] uint16 class ids or IGNORE of a view; None without a mask; ``UserError`` if it cannot be read."""
        path = self.masks[view]
        return None if path is None else read_mask(path, self.kind, self.ignore_ids)

    def paths(self, views: Sequence[int]) -> str:
        """The masks of some views for a message: the first by its path, others by what follows the folder."""
        found = [path for view in views if (path := self.masks[view]) is not None]
        return named(
            [
                path.relative_to(self.folder) if i and path.is_relative_to(self.folder) else path
                for i, path in enumerate(found)
            ]
        )


@dataclass
class Coverage:
    """How much of every view each id covers.

    ids: sorted, without IGNORE. pixels: [V, C] of each id; ignored, size: [V] pixels unlabelled and in all (0 where
    there is no mask that can be read). usable: [V] bool, whether there is such a mask, of the right size.
    """

    ids: list[int]
    pixels: np.ndarray
    ignored: np.ndarray
    size: np.ndarray
    usable: np.ndarray
    issues: list[Issue] = field(default_factory=list)


def check_files(
    files: MaskFiles, few_views: int = FEW_VIEWS, progress: Callable[[int, int], None] | None = None
) -> Coverage:
    """Read every mask once; what is wrong with files is among the issues instead of raised."""
    views = len(files.stems)
    counts: list[dict[int, int] | None] = [None] * views
    issues: list[Issue] = []

    def look(view: int) -> dict[int, int] | Issue | None:
        path = files.masks[view]
        if path is None:
            return None
        try:
            size = image_size(path)  # of the header: what is far too large is not decoded
            if size != tuple(files.sizes[view]):
                return _wrong_size(files, view, size)
            labels = files.read(view)
        except UserError as error:
            return Issue("error", "type", str(error), STOPS, (files.stems[view],))
        assert labels is not None
        found = np.bincount(labels.ravel(), minlength=IGNORE + 1)
        if np.count_nonzero(found) > MOST_IDS:
            return _no_id_image(files, view, np.count_nonzero(found))
        return {int(i): int(found[i]) for i in np.flatnonzero(found)}

    with ThreadPoolExecutor(max_workers=4) as pool:  # decoding a .png releases the interpreter
        for view, found in enumerate(pool.map(look, range(views))):
            if isinstance(found, Issue):
                issues.append(found)
            else:
                counts[view] = found
            if progress:
                progress(view + 1, views)
    coverage = _coverage(counts)
    coverage.issues += issues
    coverage.issues += [*_missing(files), *_strays(files), *_names(files, coverage)]
    coverage.issues += [*_few_views(files, coverage, few_views), *_unlabelled(files, coverage)]
    return coverage


def _coverage(counts: Sequence[Mapping[int, int] | None]) -> Coverage:
    ids = sorted(set().union(*(found for found in counts if found)) - {IGNORE} | {BACKGROUND})
    pixels = np.array([[(found or {}).get(i, 0) for i in ids] for found in counts], np.int64).reshape(-1, len(ids))
    ignored = np.array([(found or {}).get(IGNORE, 0) for found in counts], np.int64)
    usable = np.array([found is not None for found in counts])
    return Coverage(ids, pixels, ignored, pixels.sum(1) + ignored, usable)


def _wrong_size(files: MaskFiles, view: int, found: tuple[int, ...]) -> Issue:
    width, height = files.sizes[view]
    return Issue(
        "error",
        "size",
        f"the mask {files.masks[view]} is {found[0]}x{found[1]} pixels but its image is {width}x{height}: "
        "make it from the image at its full size, or scale it by nearest neighbour.",
        STOPS,
        (files.stems[view],),
    )


def _no_id_image(files: MaskFiles, view: int, ids: int) -> Issue:
    return Issue(
        "error",
        "no id image",
        f"the mask {files.masks[view]} holds {ids} different ids: this is no id image (a photo? depth?), replace it.",
        "training stops, or, without a classes.json, takes every value for an object",
        (files.stems[view],),
    )


def _missing(files: MaskFiles) -> list[Issue]:
    trained = [view for view, used in enumerate(files.trained) if used]
    without = [files.stems[view] for view in trained if files.masks[view] is None]
    if not without:
        return []
    if len(without) == len(trained):
        return [
            Issue(
                "error",
                "missing",
                f"no training view has a mask in {files.folder}: put id images there, named as the images, or make "
                "them with: beags masks make",
                "training stops before refinement (beags-base needs no masks)",
                tuple(without),
            )
        ]
    return [
        Issue(
            "warning",
            "missing",
            f"{len(without)} of {len(trained)} training views have no mask in {files.folder}: {named(without)}; "
            "add them, or leave it to reprojection.",
            f"{percent(len(without), len(trained))} of the views do not vote; reprojection labels them from the "
            "others, and with --pipeline.model.prepare.reprojection none no loss about masks looks at them",
            tuple(without),
        )
    ]


def _strays(files: MaskFiles) -> list[Issue]:
    """Images among the masks that belong to no view: another suffix, another name."""
    if not files.folder.is_dir():
        return []
    used = {path for path in files.masks if path is not None}
    others = sorted(
        path for path in files.folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES and path not in used
    )
    if not others:
        return []
    other_type = [path for path in others if path.suffix.lower() != ".png"]
    why = "masks are .png files" if other_type else "no image has such a name"
    return [
        Issue(
            "warning",
            "unused",
            f"{len(others)} files in {files.folder} are not used ({named([path.name for path in others], 3)}), as "
            f"{why}: rename them after their images, save them as .png, or remove them.",
            "what they show does not count",
        )
    ]


def _names(files: MaskFiles, coverage: Coverage) -> list[Issue]:
    """Ids that classes.json does not name, and names that no mask holds."""
    if files.names is None or files.kind != "ids":
        return []
    issues = []
    for column, class_id in enumerate(coverage.ids):
        views = np.flatnonzero(coverage.pixels[:, column])
        if class_id == BACKGROUND or class_id in files.names or not len(views):
            continue
        pixels = int(coverage.pixels[:, column].sum())
        unlabelled = ", or, if it means unlabelled, add: beags-data --ignore-ids 255" if class_id == 255 else ""
        issues.append(
            Issue(
                "error",
                "unknown id",
                f"id {class_id} is in {len(views)} masks, the first {files.masks[views[0]]}, but not in "
                f"{files.names_file}: name it there or correct the masks{unlabelled}.",
                f"{STOPS}; the id covers {pixels} pixels ({percent(pixels, coverage.size.sum())})",
                tuple(files.stems[int(view)] for view in views),
            )
        )
    absent = [f"{i} ({name})" for i, name in files.names.items() if i != BACKGROUND and i not in coverage.ids]
    if absent:
        issues.append(
            Issue(
                "warning",
                "unused name",
                f"{files.names_file} names ids that no mask holds: {named(absent)}; remove them or correct the masks.",
                "these objects get no Gaussians and cannot be extracted",
            )
        )
    return issues


def _few_views(files: MaskFiles, coverage: Coverage, few_views: int) -> list[Issue]:
    trained = np.asarray(files.trained, bool)
    issues = []
    for column, class_id in enumerate(coverage.ids):
        present = trained & (coverage.pixels[:, column] > 0)
        count = int(present.sum())
        if class_id == BACKGROUND or count >= few_views:
            continue
        name = (files.names or {}).get(class_id, f"class_{class_id}")
        pixels = int(coverage.pixels[present, column].sum())
        where = files.paths([int(view) for view in np.flatnonzero(present)]) or "only held-out views"
        issues.append(
            Issue(
                "warning",
                "few views",
                f"id {class_id} ({name}) is in {count} of {int(trained.sum())} training views ({where}), fewer than "
                f"{few_views}: mask it in more views, or set it to 0 if it is a mistake.",
                f"its {pixels} pixels can hardly outvote or be outvoted: sides that no mask shows go to other classes",
                tuple(files.stems[int(view)] for view in np.flatnonzero(present)),
            )
        )
    return issues


def _unlabelled(files: MaskFiles, coverage: Coverage) -> list[Issue]:
    total, ignored = int(coverage.size.sum()), int(coverage.ignored.sum())
    if not total or ignored / total < LARGE_IGNORE:
        return []
    most = [int(view) for view in np.argsort(-coverage.ignored, kind="stable") if coverage.ignored[view]]
    return [
        Issue(
            "note",
            "unlabelled",
            f"{percent(ignored, total)} of the masks' pixels are unlabelled, most in {files.paths(most[:3])}: fine if "
            "nobody knows what is there, else label them (background is 0).",
            f"{ignored} pixels do not vote, and boundary and silhouette loss do not look at them",
        )
    ]
