"""Areas of masks that the other views contradict, once there is a base whose depth can be trusted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from beags_plugin.labels.class_ids import IGNORE

SMALLEST = 0.0005  # share of the image that an area must cover
RIM = 0.003  # of the image diagonal: contradiction this near an outline is that of any mask
CONFIDENCE = 0.6  # share of the votes that must contradict


@dataclass(frozen=True)
class Area:
    """A connected area of a view's mask that says ``given`` where the other views say ``voted``.

    box: (left, top, right, bottom) in pixels of the compared mask. pixels: of the area.
    """

    view: str
    given: int
    voted: int
    pixels: int
    share: float
    box: tuple[int, int, int, int]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**vars(self), "box": list(self.box)}

    def told(self, names: Mapping[int, str]) -> str:
        """The area in words."""
        left, top, right, bottom = self.box
        kinds = [f"{i} ({names.get(i, f'class_{i}')})" for i in (self.given, self.voted)]
        return f"{self.view}, x {left}-{right}, y {top}-{bottom}: {kinds[0]}, the others say {kinds[1]}"


def contradicted(given: np.ndarray, voted: np.ndarray, confidence: np.ndarray, view: str) -> list[Area]:
    """Areas of one view that are more than a rim, the largest first.

    given, voted: [H, W] class ids or IGNORE, before and after reprojection. confidence: [H, W] in 0..1.
    """
    import cv2

    height, width = given.shape
    wrong = (given != voted) & (given != IGNORE) & (voted != IGNORE) & (confidence >= CONFIDENCE)
    radius = max(1, round(RIM * math.hypot(height, width)))
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
