"""Depth distortion: it pulls the Gaussians along a ray together (method, section 1; E4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.losses.reduction import ordered_mean


@dataclass(frozen=True)
class DistortionLoss(Loss):
    """Mean over the pixels of sum_{j<i} w_i w_j (m_i - m_j)^2; off by default."""

    needs: ClassVar[frozenset[str]] = frozenset({"distortion"})

    weight: float = 0.0
    start: int = 3000

    def value(self, inputs: LossInputs) -> Tensor:
        if inputs.render.distortion is None:
            raise ValueError("the distortion loss needs a render with distortion")
        return ordered_mean(inputs.render.distortion)
