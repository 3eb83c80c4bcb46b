"""The five commands of "Every day" in README.md, a picture each; the last has two.

``python docs/pictures/everyday_picture.py TRAIN VIEW EVAL EXPORT BEFORE AFTER``: files that the commands wrote, or what
a browser showed of them; ``FILE:left,top,side`` takes that square of one, in pixels. README's are of the bear of
``beags bench captures`` (the scene, and cells of ``beags render --format before-after``), and of the demo for the tab
Pick and for ``beags eval --picture``, which shows photos.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from beags_plugin.pictures.cells import below, beside, cell, write_picture

CAPTIONS = (
    "train",
    "view, and pick by clicks",
    "eval: green is right",
    "export",
    "render: before",
    "render: after",
)
SIDE = 300
"""Pixels of each picture."""


def square(argument: str) -> NDArray[np.uint8]:
    """Return [SIDE, SIDE, 3] uint8 RGB: the square that an argument names, or the middle of its picture."""
    name, _, place = argument.partition(":")
    picture = cv2.imread(name)
    if picture is None:
        raise SystemExit(f"{name} is no picture that can be read.")
    height, width = picture.shape[:2]
    side = min(height, width)
    left, top, side = (int(word) for word in place.split(",")) if place else ((width - side) // 2, 0, side)
    part = cv2.resize(picture[top : top + side, left : left + side], (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return cv2.cvtColor(part, cv2.COLOR_BGR2RGB)


if __name__ == "__main__":
    cells = [cell(square(word), (SIDE, SIDE), caption) for word, caption in zip(sys.argv[1:], CAPTIONS, strict=True)]
    write_picture(Path("docs/images/everyday.jpg"), below([beside(cells[:3]), beside(cells[3:])]))
