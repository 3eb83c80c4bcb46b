"""Areas of masks that the other views contradict, according to the depth of a trained base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.masks.check.consistency import band

SMALLEST = 0.0005  # least share of the image
CONFIDENCE = 0.6  # least share of contradicting votes


@dataclass(frozen=True)
class Area:
    """A connected area of class ``given`` in a view's mask that the other views label ``voted``.

    share: of the image. box: (left, top, right, bottom) in pixels of the compared mask.
    """

    view: str
    given: int
    voted: int
    pixels: int
    share: float
    box: tuple[int, int, int, int]

    def to_json(self) -> dict[str, Any]:
        """Return plain values."""
        return {**vars(self), "box": list(self.box)}


def contradicted(given: np.ndarray, voted: np.ndarray, confidence: np.ndarray, view: str) -> list[Area]:
    """Find areas of one view that are wider than the band about outlines, the largest first.

    given, voted: [H, W] class ids or IGNORE, before and after reprojection. confidence: [H, W] in 0..1.
    """
    import cv2

    height, width = given.shape
    wrong = (given != voted) & (given != IGNORE) & (voted != IGNORE) & (confidence >= CONFIDENCE)
    radius = band(height, width)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    core = cv2.morphologyEx(wrong.astype(np.uint8), cv2.MORPH_OPEN, disc)
    count, pieces, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    areas = []
    for piece in range(1, count):
        left, top, wide, high, pixels = (int(value) for value in stats[piece])
        if pixels < SMALLEST * height * width:
            continue
        inside = pieces == piece
        ids = [int(np.bincount(labels[inside].astype(np.int64)).argmax()) for labels in (given, voted)]
        box = (left, top, left + wide, top + high)
        areas.append(Area(view, ids[0], ids[1], pixels, pixels / (height * width), box))
    return sorted(areas, key=lambda area: -area.pixels)
