"""Sums for the keys that occur, merged key by key."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from beags_plugin.ops import extension


class SparseSums:
    """Adds up values per key in float64, in the order of the calls; memory is linear in the keys that occurred.

    The time of a call is linear in the former keys and the new ones.
    """

    def __init__(self) -> None:
        self._native: Any = extension.module().SparseSums()

    def add(self, keys: Tensor, values: Tensor) -> None:
        """Add ``values`` [M] float32 or float64 to the sums of ``keys`` [M] int64, ascending, each at most once."""
        keys = extension.plain("keys", keys, (len(keys),), torch.int64)
        values = extension.plain("values", values, (len(keys),), values.dtype)
        extension.function("add", values, self._native)(keys, values)

    def totals(self) -> tuple[Tensor, Tensor]:
        """Return the keys [K] int64, ascending, and their sums [K] float64."""
        keys = torch.empty(self._native.count, dtype=torch.int64)
        sums = torch.empty(len(keys), dtype=torch.float64)
        self._native.write(keys, sums)
        return keys, sums
