"""Class ids with a meaning of their own, and small functions on label maps (method, section 0)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

BACKGROUND = 0  # everything that is no object
IGNORE = 65535  # an unlabelled pixel, which casts no vote and enters no loss


def objects_in(labels: Tensor) -> list[int]:
    """Return the ids of the objects in labels [H, W] int, ascending, without background and IGNORE."""
    ids = torch.bincount(labels.reshape(-1)).nonzero()[:, 0].tolist()
    return [class_id for class_id in ids if class_id not in (BACKGROUND, IGNORE)]


def count_ids(labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ids in labels [H, W], ascending, and the number of pixels of each, int64.

    It counts runs of equal pixels: sorting those of a large photo, as ``np.unique`` does, takes most of a second.
    """
    flat = labels.ravel()
    ends = np.append(np.flatnonzero(flat[1:] != flat[:-1]), np.arange(flat.size)[-1:])  # last pixels of the runs
    ids, place = np.unique(flat[ends], return_inverse=True)
    return ids, np.bincount(place.ravel(), np.diff(ends, prepend=-1), len(ids)).astype(np.int64)


def resize_nearest(labels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a map [H', W'] to [height, width]: each new pixel takes the old pixel under its centre.

    The old index is (i + 0.5) old / new, rounded down, in integers; OpenCV's is half a pixel off.
    """
    rows = (2 * np.arange(height) + 1) * labels.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * labels.shape[1] // (2 * width)
    return np.ascontiguousarray(labels[rows[:, None], columns[None, :]])
