"""Sums whose order does not depend on the number of threads."""

from __future__ import annotations

import torch
from torch import Tensor

_ROW = 1024  # a whole-tensor sum splits its range by the number of threads; sums of rows never split a row


def ordered_sum(values: Tensor) -> Tensor:
    """Return the sum of all elements, bit for bit the same for any number of threads; differentiable.

    values: any shape, float. Returns a scalar of the same dtype.
    """
    values = values.reshape(-1)
    while values.numel() > _ROW:
        if missing := -values.numel() % _ROW:
            values = torch.nn.functional.pad(values, (0, missing))
        values = values.view(-1, _ROW).sum(1)
    return values.sum()  # too few elements to be split


def ordered_mean(values: Tensor) -> Tensor:
    """Return the mean of all elements (0 of none), as ``ordered_sum``."""
    return ordered_sum(values) / max(values.numel(), 1)
