"""Assign each Gaussian to the class to which it contributes most (method, section 3; E6)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from beags_plugin.assignment.contributions import Contributions


@dataclass(frozen=True)
class Assignment:
    """The classes of N Gaussians, which refinement does not change.

    class_ids: [N] int32, phi; 0 (background) if never seen.
    margin: [N] float32 in 0..1, the class's share of the Gaussian's contributions; 0 if never seen.
    never_seen: [N] bool, whether the Gaussian contributes to no labelled pixel of any view.
    """

    class_ids: Tensor
    margin: Tensor
    never_seen: Tensor

    def __getitem__(self, selection: Tensor) -> Assignment:
        """Return the classes of some Gaussians; selection: [N] bool or [M] int64."""
        return Assignment(self.class_ids[selection], self.margin[selection], self.never_seen[selection])


def by_largest(sums: Contributions) -> Assignment:
    """Return phi_i = argmax_c C[i, c] (E6), ties to lower ids."""
    class_ids, top, total = sums.largest()
    never_seen = total <= 0
    margin = torch.where(never_seen, 0.0, top / total.masked_fill(never_seen, 1.0))
    return Assignment(class_ids, margin.float(), never_seen)
