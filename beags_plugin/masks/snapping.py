"""Snapping of mask outlines to edges of the photo, an optional step for any source."""

from __future__ import annotations

import numpy as np

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.system.errors import UserError

EPSILON = 1e-2  # variance of colour (0..1) below which the guide counts as flat


def snap_to_edges(labels: np.ndarray, photo: np.ndarray, radius: int) -> np.ndarray:
    """Move outlines of labels [H, W] uint16 to edges of the photo [H, W, 3] uint8 RGB, by a guided filter.

    radius: pixels of the filter's window, and the largest distance of a changed label from an outline. Each class's
    indicator is filtered with the photo as guide (He et al., "Guided image filtering"); near outlines the class of the
    largest value is taken. IGNORE stays. Raises ``UserError`` where OpenCV lacks the filter.
    """
    import cv2

    if not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        raise UserError("this OpenCV has no guided filter: run beags doctor, which names the command that repairs it.")
    ids = [int(i) for i in np.unique(labels) if i != IGNORE]
    if radius < 1 or len(ids) < 2:
        return labels
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    guide = np.ascontiguousarray(photo, np.float32) / np.float32(255.0)
    flat = labels.astype(np.float32)
    near = cv2.dilate(flat, kernel) != cv2.erode(flat, kernel)
    best = np.full(labels.shape, -np.inf, np.float32)
    found = labels.copy()
    for class_id in ids:
        indicator = (labels == class_id).astype(np.float32)
        value = cv2.ximgproc.guidedFilter(guide, indicator, radius, EPSILON)
        larger = value > best
        found[larger], best[larger] = class_id, value[larger]
    return np.where(near & (labels != IGNORE), found, labels)
