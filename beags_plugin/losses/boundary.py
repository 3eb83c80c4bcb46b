"""The 2D boundary loss: no Gaussian shows where the mask is of another class (method, section 4; paper 3.3; E7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from beags_plugin.labels.borders import at_border
from beags_plugin.labels.class_ids import IGNORE
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_sum
from beags_plugin.system.errors import UserError


@dataclass(frozen=True)
class BoundaryLoss(Loss):
    """Mean over the labelled pixels of B(u) = sum_i w_i [phi_i != M'(u)]; 0 for a view without labels (E7).

    slack: how much of B costs nothing at pixels next to another class, which show both; 0 as in the paper.
    """

    needs: ClassVar[frozenset[str]] = frozenset({"boundary"})

    weight: float = 0.5

    slack: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.slack < 1.0:
            raise UserError(f"the boundary loss has slack = {self.slack}: give a share of a pixel, 0 or more, below 1.")

    def value(self, inputs: LossInputs) -> Tensor:
        if inputs.labels is None:
            return inputs.render.color.new_zeros(())
        if inputs.render.boundary is None:
            raise ValueError("the boundary loss needs a render with a target")
        labelled = (inputs.labels - IGNORE).count_nonzero()  # a third of the time of comparing and summing
        wrong = beyond_slack(inputs.render.boundary, inputs.labels, self.slack)
        # As a tensor: of a GPU's, the host would have to wait for the number.
        return ordered_sum(wrong) / labelled.clamp(min=1)  # B is 0 at IGNORE


def beyond_slack(wrong: Tensor, labels: Tensor, slack: float) -> Tensor:
    """Return ``wrong`` [H, W], at pixels next to another class what exceeds ``slack``. labels: [H, W] int, M'."""
    return wrong if slack == 0.0 else torch.where(at_border(labels), (wrong - slack).clamp_min(0.0), wrong)
