"""Snapping of mask outlines to edges of the photo, an optional step for any source."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch

from beags_plugin.labels.class_ids import IGNORE

EPSILON = 1e-2  # variance of colour (0..1) below which the guide counts as flat


def snap_to_edges(labels: np.ndarray, photo: np.ndarray, radius: int) -> np.ndarray:
    """Move outlines of labels [H, W] uint16 to edges of the photo [H, W, 3] uint8 RGB, by a guided filter.

    radius: pixels of the filter's window, and the largest distance of a changed label from an outline. Each class's
    indicator is filtered with the photo as guide (He et al., "Guided image filtering", for colour); near outlines
    the class of the largest value is taken. IGNORE stays. OpenCV's own filter is not used: it is in a package, contrib,
    that overwrites files of the one that nerfstudio installs.
    """
    import cv2

    ids = [int(i) for i in np.unique(labels) if i != IGNORE]
    if radius < 1 or len(ids) < 2:
        return labels
    kernel = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    guide = np.ascontiguousarray(photo, np.float32) / np.float32(255.0)
    flat = labels.astype(np.float32)
    near = cv2.dilate(flat, kernel) != cv2.erode(flat, kernel)
    # Fits of a class's indicator to the colours, in the windows that hold a pixel near an outline.
    mean = partial(cv2.blur, ksize=kernel.shape, borderType=cv2.BORDER_REFLECT)
    window = cv2.dilate(near.astype(np.uint8), kernel) > 0
    colors = mean(guide)
    products = mean((guide[..., :, None] * guide[..., None, :]).reshape(*labels.shape, 9))[window].reshape(-1, 3, 3)
    covariance = products - colors[window][:, :, None] * colors[window][:, None, :]
    # numpy's inverse takes 1 ms a matrix where other programs use its library's threads
    inverse = torch.linalg.inv(torch.from_numpy(covariance) + EPSILON * torch.eye(3)).numpy()
    slope = np.zeros_like(guide)
    best = np.full(labels.shape, -np.inf, np.float32)
    found = labels.copy()
    for class_id in ids:
        indicator = (labels == class_id).astype(np.float32)
        share = mean(indicator)
        together = mean(guide * indicator[..., None]) - colors * share[..., None]
        slope[window] = (inverse @ together[window][..., None])[..., 0]
        value = (mean(slope) * guide).sum(axis=2) + mean(share - (slope * colors).sum(axis=2))
        larger = value > best
        found[larger], best[larger] = class_id, value[larger]
    return np.where(near & (labels != IGNORE), found, labels)
