"""Lots that a view draws: by seed, purpose and its own name, so that no view's lot depends on the other views."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np


def view_generator(seed: int, view: str, purpose: int) -> np.random.Generator:
    """Return the random numbers of a view for one purpose."""
    # crc32, since Python's own string hash differs from run to run.
    return np.random.default_rng([seed, purpose, zlib.crc32(view.encode())])


def lowest_lots(names: Sequence[str], seed: int, count: int, purpose: int) -> set[str]:
    """Return the ``count`` names whose lot is lowest."""
    lots = sorted((float(view_generator(seed, name, purpose).random()), name) for name in names)
    return {name for _, name in lots[:count]}
