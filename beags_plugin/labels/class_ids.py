"""Class ids that have a meaning of their own, and what class maps need besides (method, section 0)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

BACKGROUND = 0  # everything that is no object
IGNORE = 65535  # an unlabelled pixel: it neither votes nor is penalised


def objects_in(labels: Tensor) -> list[int]:
    """The ids of the objects that a mask [H, W] int shows, ascending: all but background (0) and IGNORE."""
    found = torch.bincount(labels.reshape(-1)).nonzero()[:, 0].tolist()
    return [class_id for class_id in found if class_id not in (0, IGNORE)]


def resize_nearest(labels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a map [H', W'] to [height, width]: each new pixel takes the old one under its centre.

    The arithmetic is in integers: (i + 0.5) old / new, rounded down. (OpenCV's nearest is half a new pixel off.)
    """
    rows = (2 * np.arange(height) + 1) * labels.shape[0] // (2 * height)
    columns = (2 * np.arange(width) + 1) * labels.shape[1] // (2 * width)
    return np.ascontiguousarray(labels[rows[:, None], columns[None, :]])
