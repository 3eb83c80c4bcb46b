"""Sparse sums over (row, column) pairs of a wide table."""

from __future__ import annotations

import torch
from torch import Tensor


class TorchSparseSums:
    """The torch version of the compiled ``ops.sparse_sums.SparseSums``, with the bits of a dense table of sums."""

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._keys = torch.zeros(0, dtype=torch.int64, device=device)  # ascending
        self._sums = torch.zeros(0, dtype=torch.float64, device=device)

    def add(self, keys: Tensor, values: Tensor) -> None:
        at = torch.searchsorted(self._keys, keys)
        known = torch.zeros_like(keys, dtype=torch.bool)
        if len(self._keys):
            known = self._keys[at.clamp(max=len(self._keys) - 1)] == keys
            self._sums[at[known]] += values[known].double()
        fresh, values, place = keys[~known], values[~known].double(), at[~known]
        place = place + torch.arange(len(place), device=place.device)  # index among all keys
        former = torch.ones(len(self._keys) + len(fresh), dtype=torch.bool, device=place.device)
        former[place] = False
        merged_keys, merged_sums = fresh.new_empty(len(former)), values.new_empty(len(former))
        merged_keys[former], merged_keys[place] = self._keys, fresh
        merged_sums[former], merged_sums[place] = self._sums, values
        self._keys, self._sums = merged_keys, merged_sums

    def totals(self) -> tuple[Tensor, Tensor]:
        return self._keys, self._sums


def largest_in_rows(keys: Tensor, sums: Tensor, rows: int, columns: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return per row the first column of the largest sum, that sum, and the total; 0 for rows without sums.

    keys: [K] int64, row * columns + column, ascending. sums: [K] float64, above 0.
    Returns [rows] int64 and twice [rows] float64.
    """
    row, column = keys // columns, keys % columns
    zeros = torch.zeros(rows, dtype=torch.float64, device=keys.device)
    top = zeros.scatter_reduce(0, row, sums, "amax")
    leads = sums == top[row]
    first = torch.full((rows,), columns, dtype=torch.int64, device=keys.device)
    first = first.scatter_reduce(0, row[leads], column[leads], "amin")
    # Determinism: keys ascend, so each row's total adds its columns in order.
    return first.masked_fill(first == columns, 0), top, zeros.index_add(0, row, sums)
