"""Dot products. Determinism: unlike those of a BLAS, sums have one order for any number of threads."""

from __future__ import annotations

import numpy as np


def dots(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the dot products over the last axis, [...] float64; one, other: [..., C] float64, or [C] for all."""
    return np.einsum("...c,...c->...", one, other)
