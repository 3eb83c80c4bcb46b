"""Pixels at the borders of classes."""

from __future__ import annotations

import torch
from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE


def at_border(labels: Tensor) -> Tensor:
    """Return the pixels that have another class among their eight neighbours, [H, W] bool.

    labels: [H, W] int class ids or IGNORE. Unlabelled pixels are at no border, and make none.
    """
    border = torch.zeros_like(labels, dtype=torch.bool)
    height, width = labels.shape
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        first = (slice(0, height - down), slice(max(-right, 0), width - max(right, 0)))
        second = (slice(down, height), slice(max(right, 0), width - max(-right, 0)))
        a, b = labels[first], labels[second]
        differ = (a != b) & (a != IGNORE) & (b != IGNORE)
        border[first] |= differ
        border[second] |= differ
    return border
