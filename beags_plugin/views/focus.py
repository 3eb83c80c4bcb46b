"""Focus: whether training sees close-ups of objects, and where the objects are in its photos."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import cv2
import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from beags_plugin.labels.class_ids import BACKGROUND, IGNORE, count_ids
from beags_plugin.labels.classes import read_id_mask
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say
from beags_plugin.views.close_ups import MOST_BYTES, CloseUps, kept_pixels, kept_size, read_close_ups
from beags_plugin.views.photo_files import Box, PhotoFiles

SHARE = 0.5
"""Default share of the steps that see a close-up."""
MOST_COVERED = 0.4
"""Share of the photos' pixels from which on objects are large enough without close-ups."""
PIXELS = 0.6
"""Pixels of a step with a close-up, over those of a whole photo: a close-up has more Gaussians per pixel, which cost
time."""
LEAST_GAIN = 1.2
"""Magnification of objects by close-ups, below which they are not worth their steps."""
MARGIN = 0.1  # space on each side of an object, over its longer side
LEAST_PART = 0.05  # least share of an object's pixels in a part of its mask; smaller parts count as errors
CLOSE = 1.25  # boxes are joined if the joint box has at most this many times their pixels
LEAST_SIDE = 32  # least pixels of a close-up's side; SSIM's window has 11


@dataclass(frozen=True)
class Aim:
    """Where the objects of a photo are.

    objects: their ids. boxes: of its close-ups. covered: share of its pixels that show objects. gain: magnification of
    objects in close-ups over the whole photo at the size of the training. side: side of a square with the mean area of
    the objects' boxes, pixels of the whole photo.
    """

    objects: list[int]
    boxes: list[Box]
    covered: float
    gain: float = 1.0
    side: float = 0.0


def share_of(focus: str) -> float | None:
    """Return the share of the steps that the option names; None for auto.

    Raises ``UserError`` for other values than auto, off and a share.
    """
    if focus in ("auto", "off"):
        return None if focus == "auto" else 0.0
    with suppress(ValueError):
        if 0.0 <= float(focus) <= 1.0:
            return float(focus)
    raise UserError(f"datamanager.focus is {focus}: give auto, off, or the share of the steps with objects, 0 to 1.")


@dataclass(frozen=True)
class _Plan:
    """Which close-ups training sees.

    share: of the steps. pixels: of a step. aims: by photo, of those with labels. covered, gain, side: means of the aims
    with objects.
    """

    share: float
    pixels: int
    aims: dict[int, Aim]
    covered: float
    gain: float
    side: float

    def __str__(self) -> str:
        return (
            f"Objects cover {self.covered:.1%} of the photos that show them: {self.share:.0%} of the steps see "
            f"close-ups of them, in which they are about {self.side * self.gain:.0f} pixels large, not {self.side:.0f}."
        )


def focused(
    focus: str, files: PhotoFiles, labels: Callable[[int], Tensor | None], names: Sequence[str], seed: int
) -> CloseUps | None:
    """Return the close-ups that training sees; None if it sees whole photos alone.

    labels: returns the labels of a photo [H, W] int32 at the size of the training, or None. names: of the photos. The
    choice is printed in a line.
    """
    plan = _planned(focus, files, labels)
    if plan is not None:
        say(str(plan))
    if not isinstance(plan, _Plan):
        return None
    kept = kept_pixels(plan.pixels, len(files.cameras))
    with ThreadPoolExecutor(max_workers=2) as pool:
        aimed = [photo for photo, aim in plan.aims.items() if aim.boxes]
        read = pool.map(lambda photo: read_close_ups(files, photo, plan.aims[photo].boxes, kept), aimed)
        photos = track(read, "Reading close-ups", total=len(aimed), transient=True)
        close_ups = [close_up for of_photo in photos for close_up in of_photo]
    return CloseUps(close_ups, names, plan.pixels, plan.share, seed, plan.gain)


def sees_close_ups(focus: str, files: PhotoFiles) -> bool:
    """Return whether a training on these photos and their masks sees close-ups with this value of the option."""

    def labels(photo: int) -> Tensor | None:
        mask = files.mask_labels(photo)
        return None if mask is None else torch.from_numpy(mask.astype(np.int32))

    return isinstance(_planned(focus, files, labels), _Plan)


def _planned(focus: str, files: PhotoFiles, labels: Callable[[int], Tensor | None]) -> _Plan | str | None:
    """Return which close-ups training sees; otherwise a sentence on why it sees none, or None."""
    share = share_of(focus)
    if share == 0.0 or (share is None and not _scaled_down(files)):
        return None
    cameras = files.cameras
    pixels = max(round(PIXELS * float((cameras.width * cameras.height).double().mean())), 1)
    if share is None and (size := 3.0 * pixels * len(cameras)) > MOST_BYTES:
        return f"Close-ups of {len(cameras)} photos would take {size / 1e9:.1f} GB: focus is off."
    kept = kept_pixels(pixels, len(cameras))
    aims = {
        photo: _aim(files, photo, mask.cpu().numpy(), kept)
        for photo in track(range(len(cameras)), "Looking for objects", transient=True)
        if (mask := labels(photo)) is not None
    }
    if line := _lost(files, {each for aim in aims.values() for each in aim.objects}):
        say(line)
    with_objects = [aim for aim in aims.values() if aim.boxes]
    if not with_objects:
        return None if share is None else "No mask of a training photo shows an object: focus is off."
    covered = float(np.mean([aim.covered for aim in with_objects]))
    gain = float(np.mean([aim.gain for aim in with_objects]))
    if share is None and gain < LEAST_GAIN:
        return None
    if share is None and covered >= MOST_COVERED:
        return f"Objects cover {covered:.0%} of the photos that show them: training sees whole photos (focus is off)."
    side = float(np.mean([aim.side for aim in with_objects]))
    return _Plan(SHARE if share is None else share, pixels, aims, covered, gain, side)


def _lost(files: PhotoFiles, found: set[int]) -> str | None:
    """Return a sentence on objects in masks that no photo shows at the size of the training; None if there are none.

    found: ids of the objects that photos show at that size. Masks are read again only if an object of ``classes`` is
    missing.
    """
    metadata = files.dataset.metadata
    missing = metadata["classes"].keys() - found - {BACKGROUND}
    lost: set[int] = set()
    for mask in track(metadata["mask_filenames"] if missing else [], "Looking for small objects", transient=True):
        if mask is not None and not missing <= lost:
            ids = read_id_mask(mask, metadata["ignore_ids"])
            lost |= missing & set(np.flatnonzero(np.bincount(ids.ravel())).tolist())
    if not lost:
        return None
    names = ", ".join(metadata["classes"][each] for each in sorted(lost))
    of_it, small, lies = ("it", "it is", "lies") if len(lost) == 1 else ("them", "they are", "lie")
    return (
        f"No photo shows {names} at the size of the training, so there will be no close-ups and no Gaussians of "
        f"{of_it}: {small} too small (a lower --downscale-factor keeps more of the photos), or {lies} where removing "
        "the lens distortion cuts the photos off."
    )


def _scaled_down(files: PhotoFiles) -> bool:
    """Return whether close-ups of any photo can show objects enough larger than the whole photo does."""
    widths = files.cameras.width.flatten().tolist()
    return any(files.full_camera(photo).width >= LEAST_GAIN * width for photo, width in enumerate(widths))


def aim_by(close_ups: CloseUps, files: PhotoFiles, labels: Sequence[Tensor]) -> None:
    """Add close-ups of photos without any, if their labels [H, W] int show objects, as after reprojection."""
    for photo in close_ups.blind():
        whole = labels[photo].cpu().numpy().astype(np.int32)
        if boxes := _aim(files, photo, whole, close_ups.kept).boxes:
            close_ups.add(read_close_ups(files, photo, boxes, close_ups.kept, whole))


def _aim(files: PhotoFiles, photo: int, labels: np.ndarray, kept: float) -> Aim:
    covered = float(((labels != BACKGROUND) & (labels != IGNORE)).mean())
    parts = dict(_boxes(labels))
    if not parts:
        return Aim([], [], covered)
    camera = files.full_camera(photo)
    scale = np.array([camera.width / labels.shape[1], camera.height / labels.shape[0]] * 2)
    full = partial(_full_box, scale=scale, width=camera.width, height=camera.height)
    boxes = [full(box) for box in _joined([_with_margin(box) for box in parts.values()])]
    shares = [np.prod(kept_size(box, len(boxes), kept)) / _area(box) for box in boxes]
    gain = float(np.sqrt(np.average(shares, weights=[_area(box) for box in boxes]) * scale[0] * scale[1]))
    side = float(np.sqrt(np.mean([_area(box) for box in parts.values()])))
    return Aim(list(parts), boxes, covered, gain, side)


def _boxes(labels: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Yield id and box of each object of labels [H, W], without small separate parts of its mask."""
    for class_id in count_ids(labels)[0]:
        if class_id in (BACKGROUND, IGNORE):
            continue
        _, _, stats, _ = cv2.connectedComponentsWithStats((labels == class_id).astype(np.uint8), connectivity=8)
        parts = stats[1:]
        parts = parts[parts[:, cv2.CC_STAT_AREA] >= LEAST_PART * parts[:, cv2.CC_STAT_AREA].sum()]
        left_top = parts[:, [cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP]]
        right_bottom = left_top + parts[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
        yield int(class_id), np.concatenate([left_top.min(axis=0), right_bottom.max(axis=0)]).astype(np.float64)


def _with_margin(box: np.ndarray) -> np.ndarray:
    margin = MARGIN * max(box[2] - box[0], box[3] - box[1])
    return box + margin * np.array([-1.0, -1.0, 1.0, 1.0])


def _area(box: Sequence[float] | np.ndarray) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))


def _joined(boxes: list[np.ndarray]) -> list[np.ndarray]:
    """Return the boxes, with those close to each other joined."""
    for one, other in combinations(range(len(boxes)), 2):
        whole = np.concatenate([np.minimum(boxes[one], boxes[other])[:2], np.maximum(boxes[one], boxes[other])[2:]])
        if _area(whole) <= CLOSE * (_area(boxes[one]) + _area(boxes[other])):
            rest = [box for index, box in enumerate(boxes) if index not in (one, other)]
            return _joined([*rest, whole])
    return boxes


def _full_box(box: np.ndarray, scale: np.ndarray, width: int, height: int) -> Box:
    """Return a box in pixels of the file, inside it, with sides of at least ``LEAST_SIDE`` if the file is as large."""
    sides = []
    for low, high, size in zip((box * scale)[:2], (box * scale)[2:], (width, height), strict=True):
        first, last = max(round(low), 0), min(round(high), size)
        if last - first < (least := min(LEAST_SIDE, size)):
            first = min(max((first + last - least) // 2, 0), size - least)
            last = first + least
        sides.append((first, last))
    (left, right), (top, bottom) = sides
    return left, top, right, bottom
