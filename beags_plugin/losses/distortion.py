"""Depth distortion: gathers the weights along a ray (2DGS paper, section 5)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from beags_plugin.losses.base import Loss, LossInputs


@dataclass(frozen=True)
class DistortionLoss(Loss):
    """Mean over pixels of the rendered distortion (E4)."""

    needs: ClassVar[frozenset[str]] = frozenset({"distortion"})

    weight: float = 0.0
    start: int = 3_000

    def value(self, inputs: LossInputs) -> Tensor:
        assert inputs.render.distortion is not None
        return inputs.render.distortion.mean()
