"""Move outlines of new masks to edges of the photo."""

from __future__ import annotations

import numpy as np

from beags_plugin.labels.class_ids import IGNORE, count_ids
from beags_plugin.system.errors import UserError

EPSILON = 1e-4  # variance of linear colour (0..1) below which the guide counts as flat
GAMMA = 2.2  # exponent from a photo to linear light, in which a pixel on an edge is the mean of both sides
_LINEAR = (255.0 * (np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


def snap_to_edges(labels: np.ndarray, photo: np.ndarray, radius: int) -> np.ndarray:
    """Move outlines of labels [H, W] uint16 to edges of the photo [H, W, 3] uint8 RGB, by a guided filter.

    radius: of the filter, and the largest distance of a changed label from an outline, pixels. The indicator of each
    class is filtered with the photo as guide, in linear light (He et al., "Guided image filtering"); near outlines the
    class of the largest value is taken. IGNORE stays. Raises ``UserError`` where OpenCV lacks the filter, as where
    plain OpenCV was installed over the contrib build.
    """
    import cv2

    if not hasattr(getattr(cv2, "ximgproc", None), "guidedFilter"):
        raise UserError("this OpenCV has no guided filter: run beags doctor, which names the command that repairs it.")
    ids = [i for i in count_ids(labels)[0].tolist() if i != IGNORE]
    if radius < 1 or len(ids) < 2:
        return labels
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    # The guide is in 0..255: in 0..1, with so small an epsilon, OpenCV silently treats many covariances as singular.
    guide = _LINEAR[photo]
    flat = labels.astype(np.float32)
    near = cv2.dilate(flat, kernel) != cv2.erode(flat, kernel)
    best = np.full(labels.shape, -np.inf, np.float32)
    snapped = labels.copy()
    for class_id in ids:
        indicator = (labels == class_id).astype(np.float32)
        part = _around(indicator, 4 * radius)
        own_guide, own = np.ascontiguousarray(guide[part]), np.ascontiguousarray(indicator[part])
        value = cv2.ximgproc.guidedFilter(own_guide, own, radius, EPSILON * 255.0**2)
        larger = value > best[part]
        snapped[part][larger], best[part][larger] = class_id, value[larger]
    return np.where(near & (labels != IGNORE), snapped, labels)


def _around(indicator: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Return the box of the nonzero part of [H, W] with a margin in pixels, beyond which the filter gives 0."""
    spans = (np.flatnonzero(indicator.any(axis=axis)) for axis in (1, 0))
    rows, columns = (slice(max(span[0] - margin, 0), span[-1] + 1 + margin) for span in spans)
    return rows, columns
