"""Sums of rows by groups."""

from __future__ import annotations

import torch
from torch import Tensor


def grouped_sums(rows: Tensor, groups: Tensor, count: int) -> Tensor:
    """Return [count, C], the sums of the rows of each group, 0 of none; differentiable.

    rows: [P, C] float. groups: [P] int, below ``count``. Rows are added in their order and in float64, whatever the
    number of threads; the sums have the rows' dtype.
    """
    channels = rows.shape[1]
    # Determinism: index_add adds one by one only into a vector.
    entries = groups.long()[:, None] * channels + torch.arange(channels, device=rows.device)
    flat = rows.new_zeros(count * channels, dtype=torch.float64)
    return flat.index_add(0, entries.view(-1), rows.double().reshape(-1)).view(count, channels).to(rows.dtype)
