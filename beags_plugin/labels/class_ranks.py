"""Consecutive numbers for class ids that may lie far apart."""

from __future__ import annotations

import torch
from torch import Tensor


class ClassRanks:
    """Ranks 0, 1, ... of class ids in ascending order, so that ties between classes are decided as by ids.

    Arrays with an entry per class then grow with the number of classes, not with the largest id (up to 65534). ids: int
    tensor of any shape, 0 .. 65534, repeated or not; background (0) is always included.
    """

    def __init__(self, ids: Tensor) -> None:
        ids = ids.reshape(-1).int()
        self.ids = torch.unique(torch.cat([ids.new_zeros(1), ids]))  # sorted
        # A table of the ids -1, 0, ... to one past the last takes a fifth of the time of a search, and at most 256 KB.
        self._table = self.ids.new_full((int(self.ids[-1]) + 3,), len(self.ids))
        self._table[self.ids.long() + 1] = torch.arange(len(self.ids), dtype=torch.int32, device=ids.device)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def trivial(self) -> bool:
        """Return whether every rank equals its id."""
        return int(self.ids[-1]) + 1 == len(self)

    def ranks(self, class_ids: Tensor) -> Tensor:
        """Return the rank of each id, int32; ``len(self)`` for an unknown id. class_ids: int of any shape."""
        place = class_ids.reshape(-1).int().clamp(-1, len(self._table) - 2) + 1
        return self._table.to(place.device).index_select(0, place).view(class_ids.shape)

    def class_ids(self, ranks: Tensor) -> Tensor:
        """Return the ids of ranks 0 .. ``len(self)`` - 1, int32. ranks: int of any shape."""
        return self.ids.to(ranks.device)[ranks.long()]
