"""The Gaussians of each class, known on the host, so that a step need not wait for a GPU."""

from __future__ import annotations

import torch
from torch import Tensor


class ClassMembers:
    """The Gaussians of every class.

    class_ids: [N] int. They are sorted at the first call of ``of``, and must not change before it (``current``).
    """

    def __init__(self, class_ids: Tensor) -> None:
        self._source, self._version = class_ids, class_ids._version
        self._order = class_ids.new_zeros(0, dtype=torch.int64)
        self._spans: dict[int, tuple[int, int]] | None = None

    def current(self, class_ids: Tensor) -> bool:
        """Return whether ``class_ids`` are the same ids, unchanged.

        Writes through ``.data`` or numpy go unnoticed, because torch does not count them.
        """
        return class_ids is self._source and class_ids._version == self._version

    def of(self, class_id: int) -> Tensor:
        """Return [M] int64, ascending: the indices of the class's Gaussians, on the device of the ids."""
        if self._spans is None:
            ordered, self._order = torch.sort(self._source, stable=True)
            ids, counts = torch.unique_consecutive(ordered, return_counts=True)
            ends = counts.cumsum(0)
            spans = torch.stack([ids.long(), ends - counts, ends], dim=1).tolist()
            self._spans = {each: (first, end) for each, first, end in spans}
        first, end = self._spans.get(class_id, (0, 0))
        return self._order[first:end]
