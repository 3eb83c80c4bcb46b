"""Dot products whose sums have one order, whatever the number of threads; those of a BLAS have not."""

from __future__ import annotations

import numpy as np


def dots(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the dot products over the last axis, [...] float64; one, other: [..., C] float64, or [C] for all."""
    return np.einsum("...c,...c->...", one, other)
