"""Mean opacity: what no view asks for fades out (ours; off by default)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from beags_plugin.core.surfels import opacities
from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_mean


@dataclass(frozen=True)
class OpacityLoss(Loss):
    """Mean opacity of the N surfels: a steady pull that only what the photographs need withstands.

    It does slowly what the reset of opacities does at a blow, so that short runs get rid of veils in the air too.
    """

    weight: float = 0.0

    def value(self, inputs: LossInputs) -> Tensor:
        return ordered_mean(opacities(inputs.surfels.opacity_logits))
