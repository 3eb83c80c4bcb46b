"""Sums for the (row, column) pairs that occur, of a table too wide to keep whole."""

from __future__ import annotations

import torch
from torch import Tensor


class SparseSums:
    """Adds up values per key in float64, in the order in which they come; memory is linear in the keys that occurred.

    The same bits as a dense table of zeros to which the values are added: adding 0 changes nothing.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.keys = torch.zeros(0, dtype=torch.int64, device=device)  # ascending
        self.sums = torch.zeros(0, dtype=torch.float64, device=device)

    def add(self, keys: Tensor, values: Tensor) -> None:
        """Add ``values`` [M] float to the sums of ``keys`` [M] int64, ascending, each at most once."""
        at = torch.searchsorted(self.keys, keys)
        known = torch.zeros_like(keys, dtype=torch.bool)
        if len(self.keys):
            known = self.keys[at.clamp(max=len(self.keys) - 1)] == keys
            self.sums[at[known]] += values[known].double()
        if not bool(known.all()):
            self._insert(keys[~known], values[~known].double(), at[~known])

    def _insert(self, keys: Tensor, values: Tensor, at: Tensor) -> None:
        """Put new keys before the present ones ``at`` [M] int64."""
        place = at + torch.arange(len(at), device=at.device)
        former = torch.ones(len(self.keys) + len(keys), dtype=torch.bool, device=at.device)
        former[place] = False
        for name, fresh in (("keys", keys), ("sums", values)):
            merged = fresh.new_empty(len(former))
            merged[former] = getattr(self, name)
            merged[place] = fresh
            setattr(self, name, merged)

    def largest(self, rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
        """Of each row, where key = row * columns + column: the column of its largest sum (of equals the first; 0 where
        the row has none) [rows] int64, that sum and the sum of all, [rows] float64."""
        row, column = self.keys // columns, self.keys % columns
        zeros = torch.zeros(rows, dtype=torch.float64, device=self.keys.device)
        top = zeros.scatter_reduce(0, row, self.sums, "amax")
        leads = self.sums == top[row]
        first = torch.full((rows,), columns, dtype=torch.int64, device=self.keys.device)
        first = first.scatter_reduce(0, row[leads], column[leads], "amin")
        # one after the other, in the order of the columns
        return first.masked_fill(first == columns, 0), top, zeros.index_add(0, row, self.sums)
