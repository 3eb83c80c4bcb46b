"""Signs that an image of class ids was damaged: smoothing, lossy compression, or palettes that differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from beags_plugin.labels.class_ids import IGNORE, count_ids
from beags_plugin.system.errors import UserError

LEAST_RAMPS = 12  # least outlines with a value in between, over all rows and columns; fewer may be chance
RAMPS = 0.3  # least share of such outlines; thin objects cause few, a smoothed mask of ids 0 and 2 has half
_WIDTHS = {1: RAMPS, 2: 0.8}
"""Width in pixels of the value in between, to that share. A rim of two pixels may be a thin object, unless its id also
fills areas."""
LEAST_SOLID = 0.2  # least share of pixels amid 3 x 3 of one id; an image with less is noise, which has no outlines
MOST_DUST = 8  # ids that fill no area of 3 x 3 pixels but lie about in ``PIECES`` pieces each, from which a mask is bad
PIECES = 4
MOST_IN_DUST = 0.5  # share of pixels with ids that fill no area, above which an image is a picture

_COLORS = "beags masks make --source id-images --options folder=FOLDER colors=true"


def check_ids(path: Path | str, labels: np.ndarray) -> None:
    """Raise ``UserError`` for labels [H, W] of a file that look smoothed or lossily compressed."""
    if len(count_ids(labels)[0]) < 3 or min(labels.shape) < 3:
        return
    if (between := _ramps(labels)) is not None and _solid(labels).mean() >= LEAST_SOLID:
        raise UserError(
            f"the mask {path} has values between its ids along outlines ({_listed(between)}), as scaling with "
            "smoothing or antialiasing leaves them: scale id images by nearest neighbour, or make them anew."
        )
    check_areas(path, labels, "values")


def check_areas(path: Path | str, labels: np.ndarray, what: str) -> None:
    """Raise ``UserError`` for labels [H, W] with many ids that fill no area. what: "values", or "colours"."""
    if min(labels.shape) < 3:
        return
    counts = np.bincount(labels.ravel())
    areas = np.bincount(labels[1:-1, 1:-1][_solid(labels)], minlength=len(counts))
    fine = (counts > 0) & (areas == 0)
    share = counts[fine].sum() / labels.size
    if what == "colours" and fine.sum() > 256 and share >= MOST_IN_DUST:
        raise UserError(f"the mask {path} is a picture of {fine.sum()} colours: give images of one colour per object.")
    corner = np.ones(labels.shape, bool)  # pixels whose id is neither to the left nor above: one or two a piece
    corner[:, 1:] &= labels[:, 1:] != labels[:, :-1]
    corner[1:] &= labels[1:] != labels[:-1]
    pieces = np.bincount(labels[corner], minlength=len(counts))
    dust = np.flatnonzero(fine & (pieces >= PIECES)).tolist()
    if len(dust) >= max(MOST_DUST, np.count_nonzero(areas)) and share < MOST_IN_DUST:
        listed = f" ({_listed(dust)})" if what == "values" else ""
        raise UserError(
            f"the mask {path} has {len(dust)} {what} that fill no area{listed}, as compression with loss (JPEG), "
            "smoothing or antialiasing leaves them along outlines: make it anew without, and save it as PNG."
        )


def _ramps(labels: np.ndarray) -> list[int] | None:
    """Return the ids that lie between others along most outlines; None for hard outlines."""
    values = labels.astype(np.int32)
    for widest, share in _WIDTHS.items():
        crossings, ramps, seen = _crossings(values, widest)
        if ramps < widest * LEAST_RAMPS or ramps < share * crossings:
            continue
        if widest == 1 or seen <= set(np.unique(labels[1:-1, 1:-1][_solid(labels)]).tolist()):
            return sorted(seen)
    return None


def _crossings(values: np.ndarray, widest: int) -> tuple[int, int, set[int]]:
    """Return the numbers of outlines and of ramps along rows and columns, and the ids within ramps.

    values: [H, W] int32. A ramp rises or falls through ids of at most ``widest`` pixels each. Jumps to the next id do
    not count, as no id lies between. Jumps to and from IGNORE are no outlines.
    """
    crossings = ramps = 0
    seen: set[int] = set()
    for image in (values, values.T):
        jump = np.diff(image, axis=1)
        jump[(image[:, 1:] == IGNORE) | (image[:, :-1] == IGNORE)] = 0
        row, at = np.nonzero(jump)
        size = jump[row, at]
        near = (row[1:] == row[:-1]) & (at[1:] - at[:-1] <= widest)
        goes_on = near & (np.sign(size[1:]) == np.sign(size[:-1]))  # the id between also lies between in value
        before, after = np.zeros(len(size), bool), np.zeros(len(size), bool)
        before[1:], after[:-1] = goes_on, goes_on
        begun = int((after & ~before).sum())
        crossings += begun + int((~after & ~before & (np.abs(size) >= 2)).sum())
        ramps += begun
        seen.update(np.unique(image[row[1:][goes_on], at[1:][goes_on]]).tolist())
    return crossings, ramps, seen


def _solid(labels: np.ndarray) -> np.ndarray:
    """Return the pixels amid 3 x 3 of one id, [H - 2, W - 2] bool, without the image's rim."""
    middle = labels[1:-1, 1:-1]
    same = np.ones(middle.shape, bool)
    for row in range(3):
        for column in range(3):
            same &= labels[row : row + middle.shape[0], column : column + middle.shape[1]] == middle
    return same


def check_palettes(masks: Sequence[Path], palettes: Sequence[Mapping[int, tuple[int, int, int]] | None]) -> None:
    """Raise ``UserError`` where palette images give one colour different ids, or black another id than the background.

    palettes: for each mask the colours of its ids, or None (``labels.classes.palette_of``).
    """
    known: dict[tuple[int, int, int], tuple[int, Path]] = {}
    for path, palette in zip(masks, palettes, strict=True):
        if palette is None or len(set(palette.values())) < len(palette):
            continue
        for index, color in palette.items():
            former, other = known.setdefault(color, (index, path))
            if former != index:
                raise UserError(
                    f"the palette images {other} and {path} give the colour {color} the ids {former} and {index}, but "
                    f"ids are the places in the palette: save all with one palette, or read the colours with {_COLORS}."
                )
            if color == (0, 0, 0) and index != 0 and 0 in palette:
                raise UserError(
                    f"the palette image {path} has black as id {index} and the colour {palette[0]} as id 0, which is "
                    f"the background: put black first in the palette, or read the colours with {_COLORS}."
                )


def _listed(ids: Sequence[int]) -> str:
    listed = ", ".join(map(str, ids[:5]))
    return f"{listed}, ..." if len(ids) > 5 else listed
