"""Which Gaussians a class has and which objects a mask shows, as the host knows them: a step need not ask a GPU."""

from __future__ import annotations

import torch
from torch import Tensor


class ClassMembers:
    """The Gaussians of every class.

    class_ids: [N] int class ids. They are looked at when a class is asked for first, and must be as they are now: ask
    ``current``.
    """

    def __init__(self, class_ids: Tensor) -> None:
        self._source, self._version = class_ids, class_ids._version
        self._order = class_ids.new_zeros(0, dtype=torch.int64)
        self._spans: dict[int, tuple[int, int]] | None = None

    def current(self, class_ids: Tensor) -> bool:
        """Whether these are the ids that are looked at, unchanged by torch's operations in place (of what is written
        through ``.data`` or numpy, torch keeps no count)."""
        return class_ids is self._source and class_ids._version == self._version

    def of(self, class_id: int) -> Tensor:
        """[M] int64, ascending: the places of the class's Gaussians, on the device of the ids."""
        if self._spans is None:
            ordered, self._order = torch.sort(self._source, stable=True)
            ids, counts = torch.unique_consecutive(ordered, return_counts=True)
            ends = counts.cumsum(0)
            spans = torch.stack([ids.long(), ends - counts, ends], dim=1).tolist()
            self._spans = {found: (first, end) for found, first, end in spans}
        first, end = self._spans.get(class_id, (0, 0))
        return self._order[first:end]
