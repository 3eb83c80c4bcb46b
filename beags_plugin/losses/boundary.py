"""The 2D boundary loss: no Gaussian shows in pixels of another class (method, section 4; paper 3.3; E7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_sum


@dataclass(frozen=True)
class BoundaryLoss(Loss):
    """Mean over the labelled pixels of B(u) = sum_i w_i [phi_i != M'(u)]; 0 for a view without labels (E7)."""

    needs: ClassVar[frozenset[str]] = frozenset({"boundary"})

    weight: float = 0.5

    def value(self, inputs: LossInputs) -> Tensor:
        if inputs.labels is None:
            return inputs.render.color.new_zeros(())
        if inputs.render.boundary is None:
            raise ValueError("the boundary loss needs a render with a target")
        labelled = (inputs.labels - IGNORE).count_nonzero()  # This takes a third of the time of comparing and summing.
        # The count stays a tensor: reading the number on the host would make it wait for the GPU.
        return ordered_sum(inputs.render.boundary) / labelled.clamp(min=1)  # B is 0 at IGNORE
