"""Masks that lack a part of an object, or take in ground beside it."""

from __future__ import annotations

import cv2
import numpy as np

PARTS = (0.15, 0.35)  # least and most of an object that is cut off or added


def damaged_mask(mask: np.ndarray, add: bool, generator: np.random.Generator) -> np.ndarray:
    """Return a mask without an object's part towards the foot of the photo, or with the ground about this foot."""
    mask, share = mask.copy(), generator.uniform(*PARTS)
    class_id = int(generator.choice(np.unique(mask[(mask != 0) & (mask != 65535)])))
    y, x = np.nonzero(mask == class_id)
    if not add:
        angle = generator.uniform(-0.6, 0.6)
        along = y * np.cos(angle) + x * np.sin(angle)
        cut = along >= np.quantile(along, 1 - share)
        mask[y[cut], x[cut]] = 0
        return mask
    centre = int(generator.uniform(*np.quantile(x, (0.25, 0.75)))), int(y.max())
    ground, width = np.zeros(mask.shape, bool), 0.25 * np.ptp(x) + 4
    while ground.sum() < share * len(y) and width < max(mask.shape):
        disc = np.zeros(mask.shape, np.uint8)
        cv2.ellipse(disc, centre, (int(width), int(0.4 * width)), 0, 0, 360, 1, -1)
        ground, width = (disc == 1) & (mask == 0), 1.08 * width
    mask[ground] = class_id
    return mask
