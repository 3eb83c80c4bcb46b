"""Cells with captions, from which pictures are made: cropping around an object, resizing, joining."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from beags_plugin.system.errors import UserError, writing

if TYPE_CHECKING:
    from torch import Tensor

CAPTION = 18  # pixels of text above each cell
FURTHER_LINE = 12  # pixels of each line of text after the first
GAP = 4  # pixels between cells
MARGIN = 0.15  # margin of a crop around the object, whose boundary may spread

Square = tuple[int, int, int]
"""(top, left, side) in pixels; it may extend beyond the image."""


def square_around(mask: np.ndarray) -> Square:
    """Return the square around the True pixels of ``mask`` [H, W] bool with a margin; else the whole image."""
    height, width = mask.shape
    if not mask.any():
        return 0, 0, max(height, width)
    ys, xs = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    side = int(max(ys[-1] - ys[0], xs[-1] - xs[0]) + 1)
    side = max(8, round(side * (1 + 2 * MARGIN)))
    return int((ys[0] + ys[-1] + 1 - side) // 2), int((xs[0] + xs[-1] + 1 - side) // 2), side


def crop(image: np.ndarray, square: Square, fill: int = 0) -> np.ndarray:
    """Return the part of an image [H, W, C] in the square, [side, side, C]; ``fill`` outside the image."""
    top, left, side = square
    part = np.full((side, side, *image.shape[2:]), fill, dtype=image.dtype)
    y0, x0 = max(top, 0), max(left, 0)
    y1, x1 = min(top + side, image.shape[0]), min(left + side, image.shape[1])
    if y1 > y0 and x1 > x0:
        part[y0 - top : y1 - top, x0 - left : x1 - left] = image[y0:y1, x0:x1]
    return part


def cell(image: np.ndarray, size: tuple[int, int], caption: str) -> np.ndarray:
    """Return [height + CAPTION, width, 3] uint8: the image resized to (width, height) below its caption.

    Each line of the caption after the first adds ``FURTHER_LINE``.
    """
    from PIL import Image, ImageDraw

    width, height = size
    enlarged = image.shape[1] < width  # enlarged pixels stay sharp, so that boundaries can be judged
    resample = Image.Resampling.NEAREST if enlarged else Image.Resampling.BOX
    lines = printable(caption).split("\n")
    above = CAPTION + FURTHER_LINE * (len(lines) - 1)
    picture = Image.new("RGB", (width, height + above), "white")
    picture.paste(Image.fromarray(image).resize(size, resample), (0, above))
    for place, line in enumerate(lines):
        ImageDraw.Draw(picture).text((2, 3 + FURTHER_LINE * place), line, fill="black")
    return np.asarray(picture)


def as_bytes(image: Tensor) -> np.ndarray:
    """Return a float image in 0..1 as uint8; values outside are clamped."""
    return (image.detach().clamp(0, 1).cpu() * 255).round().byte().numpy()


def checkerboard(height: int, width: int, side: int) -> np.ndarray:
    """Return [height, width] int64: squares of two greys, ``side`` pixels wide."""
    y, x = np.mgrid[:height, :width] // side
    return np.where((x + y) % 2, 200, 236)


def printable(text: str) -> str:
    """Return the text with a question mark for each character that the picture's font lacks."""
    return text.encode("latin-1", "replace").decode("latin-1")


def beside(cells: Iterable[np.ndarray]) -> np.ndarray:
    """Join cells of any height side by side, with a gap after each."""
    cells = list(cells)
    tallest = max(len(c) for c in cells)
    padded = [np.pad(c, ((0, tallest - len(c)), (0, GAP), (0, 0)), constant_values=255) for c in cells]
    return np.concatenate(padded, axis=1)


def below(lines: Sequence[np.ndarray]) -> np.ndarray:
    """Join lines of any width below each other, with a gap after each."""
    widest = max(line.shape[1] for line in lines)
    padded = [np.pad(line, ((0, GAP), (0, widest - line.shape[1]), (0, 0)), constant_values=255) for line in lines]
    return np.concatenate(padded, axis=0)


def wrapped(groups: Iterable[Sequence[np.ndarray]], width: int) -> list[np.ndarray]:
    """Return lines at most ``width`` pixels wide, unless one group is wider; the cells of a group stay together."""
    lines: list[list[np.ndarray]] = []
    used = 0
    for group in groups:
        needed = sum(c.shape[1] + GAP for c in group)
        if not lines or used + needed > width:
            lines.append([])
            used = 0
        lines[-1] += group
        used += needed
    return [beside(line) for line in lines]


def write_picture(path: str | Path, picture: np.ndarray) -> None:
    """Write [H, W, 3] uint8 as a PNG; raises ``UserError`` if it cannot be written."""
    from PIL import Image

    try:
        with writing(path, "the picture "):
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture).save(path)
    except ValueError as error:
        raise UserError(f"the picture {path} cannot be written ({error}): choose another name.") from error
