"""The 2D boundary loss: Gaussians must not be seen where the mask says another class (paper 3.3; E7)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from beags_plugin.losses.base import Loss, LossInputs
from beags_plugin.rasterizers.interface import IGNORE


@dataclass(frozen=True)
class BoundaryLoss(Loss):
    """Mean over labelled pixels of B(u) = sum_i w_i(u) [phi_i != M'(u)]; 0 if no pixel is labelled."""

    needs: ClassVar[frozenset[str]] = frozenset({"boundary"})

    weight: float = 0.5

    def value(self, inputs: LossInputs) -> Tensor:
        assert inputs.render.boundary is not None and inputs.labels is not None
        labelled = (inputs.labels != IGNORE).sum().clamp_min(1)  # no labelled pixel: B is 0 everywhere, and 0 / 1 = 0
        return inputs.render.boundary.sum() / labelled  # B is 0 at IGNORE pixels already
