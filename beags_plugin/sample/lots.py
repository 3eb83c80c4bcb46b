"""Random numbers of a view: by seed, purpose and its name, so that they do not depend on the other views."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

import numpy as np


def view_generator(seed: int, view: str, purpose: int) -> np.random.Generator:
    """Return the generator of a view's random numbers for one purpose."""
    # Python's own string hash differs between runs; crc32 does not.
    return np.random.default_rng([seed, purpose, zlib.crc32(view.encode())])


def lowest_lots(names: Sequence[str], seed: int, count: int, purpose: int) -> set[str]:
    """Return the ``count`` names whose random number is lowest."""
    lots = sorted((float(view_generator(seed, name, purpose).random()), name) for name in names)
    return {name for _, name in lots[:count]}
