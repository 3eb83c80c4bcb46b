"""The mask phase of COB-GS: a trained mask logit per Gaussian, and Gaussians that lie across an object's boundary.

Zhang, Jiang, Chen, Jiang, Liu: "COB-GS: Clear Object Boundaries in 3DGS Segmentation Based on Boundary-Adaptive
Gaussian Splitting", CVPR 2025. With w_i(u) the blending weights and G_v the object's mask in view v, a step renders
M(u) = sum_i sigmoid(m_i) w_i(u) with all but m frozen, and takes the linear loss sum_u (-G + lambda (1 - G)) M / (H W):

    dL/dm_i = sigmoid(m_i) (1 - sigmoid(m_i)) (lambda W_out[i, v] - W_in[i, v]) / (H_v W_v)
    r[i, v] = |n_in - n_out| / (n_in + n_out + 1e-6), 1 where both are 0;  rbar_i = mean over views

W are the sums of w_i over the pixels inside and outside of the mask, n the numbers of these pixels. No Gaussian moves
within a phase, so W and n are constant: one pass over the views replaces all renderings of the phase.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from beags_plugin.core.surfels import opacities as sigmoid  # the same bits for any number of threads
from beags_plugin.system.errors import check_choice

RATE = 0.1
BETAS = (0.9, 0.999)
EPS = 1e-15
EPOCHS = 2  # epochs of a phase
FEW_STEPS = 48  # two epochs of 24 views: from m = 0, sigmoid(m) > 0.9 needs 24 steps in one direction
OUTSIDE_WEIGHT = 1.0  # lambda
TAU = 0.8  # value for captures all around; 0.5 for forward-facing ones
SPLIT_SCALE = 0.01  # share of the scene's extent below which Gaussians are not split
THRESHOLD = 0.9
ORDERS = ("area_desc", "area_asc", "label_asc")

State = dict[str, Tensor]


class MaskLogits:
    """The logits m of one object, with their own Adam.

    logits: [N] float, initial values; 0 in the source.
    """

    def __init__(self, logits: Tensor, rate: float = RATE) -> None:
        self.rate = rate
        self._hold(logits, {})

    def _hold(self, logits: Tensor, moments: State) -> None:
        self.logits = logits.detach().clone()
        self._adam = torch.optim.Adam([self.logits], lr=self.rate, betas=BETAS, eps=EPS)
        if moments:
            self._adam.state[self.logits] = dict(moments)

    def step(self, slope: Tensor) -> None:
        """Take one step of Adam; slope: [N] the loss's derivative by sigmoid(m)."""
        p = sigmoid(self.logits)
        self.logits.grad = p * (1.0 - p) * slope
        self._adam.step()

    def follow(self, source: Tensor, fresh: Tensor) -> None:
        """Follow an edit of the scene; fresh Gaussians start at 0, and Adam's count of steps goes on for all.

        source: [M] int64, the former index of each Gaussian. fresh: [M] bool.
        """

        def moved(values: Tensor) -> Tensor:
            return values[source].masked_fill(fresh, 0.0) if values.dim() else values

        self._hold(moved(self.logits), {name: moved(values) for name, values in self._moments().items()})

    def state(self) -> State:
        """Return copies of the logits and, after the first step, of Adam's state."""
        return {name: values.clone() for name, values in {"logits": self.logits, **self._moments()}.items()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Continue from a former ``state()``; the number of Gaussians may differ."""
        moments = {name: values.clone() for name, values in state.items() if name != "logits"}
        self._hold(state["logits"], moments)

    def _moments(self) -> State:
        return dict(self._adam.state.get(self.logits, {}))


def phase_epochs(views: int) -> int:
    """Return the epochs of a mask phase over ``views`` views with masks: 2, or more for fewer than 24 views.

    The reason, the reach of the logits, does not concern texture phases, which stay at 2.
    """
    return max(EPOCHS, math.ceil(FEW_STEPS / max(views, 1)))


def play_phase(
    logits: MaskLogits,
    sums: Callable[[int], Any],
    pixels: Sequence[int],
    generator: torch.Generator,
    epochs: int = EPOCHS,
    outside_weight: float = OUTSIDE_WEIGHT,
) -> None:
    """Take the steps of a phase: every view once in each epoch, in random order, without the last step of the phase.

    In the source that step has no effect, because the edit at the end of a phase replaces the parameters before it.

    sums: returns (W_in, W_out) of a view by index, [N] each or [2, N]; called once a step, as they may lie in files.
    pixels: H_v W_v of each view with a mask. generator: on the CPU.
    """
    for view in shuffled(len(pixels), epochs, generator)[:-1]:
        inside, outside = sums(view)
        logits.step((outside_weight * outside - inside) / pixels[view])


def shuffled(views: int, epochs: int, generator: torch.Generator) -> list[int]:
    """Return the indices of views in a random order for each of ``epochs`` epochs."""
    return [view for _ in range(epochs) for view in torch.randperm(views, generator=generator).tolist()]


def mean_agreement(counts: Iterable[Any]) -> Tensor:
    """Return rbar [N] float64, the mean agreement of a Gaussian's pixels about the object.

    counts: (n_in, n_out) of each view with a mask, [N] each or [2, N], numbers of pixels; at least one view.
    """
    total, views = torch.zeros(()), 0
    for inside, outside in counts:
        inside, outside = inside.double(), outside.double()
        both = inside + outside
        total, views = total + torch.where(both > 0, (inside - outside).abs() / (both + 1e-6), 1.0), views + 1
    return total / views


def to_split(agreement: Tensor, log_scales: Tensor, extent: float, tau: float = TAU) -> Tensor:
    """Return [N] bool: Gaussians that a phase, except the last one, splits at its end. log_scales: [N, 2]."""
    return mixed(agreement, tau) & (log_scales.amax(dim=-1).exp() > SPLIT_SCALE * extent)


def mixed(agreement: Tensor, tau: float = TAU) -> Tensor:
    """Return [N] bool: Gaussians of any size that the last phase removes."""
    return agreement < tau


def object_order(areas: Mapping[int, int], order: str = ORDERS[0]) -> list[int]:
    """Return the objects in the order in which they are trained; areas: pixels of all masks of each object."""
    check_choice(order, ORDERS, "order of objects")
    sign = {"area_desc": -1, "area_asc": 1, "label_asc": 0}[order]
    return sorted(areas, key=lambda class_id: (sign * areas[class_id], class_id))


def claim(
    class_ids: Tensor, scores: Tensor, logits: Tensor, class_id: int, threshold: float = THRESHOLD
) -> tuple[Tensor, Tensor]:
    """Return ids and scores [N] after an object: it takes Gaussians for which it has the highest probability so far.

    class_ids [N] int32 and scores [N] start at 0; children of a split inherit their parent's.
    """
    p = sigmoid(logits)
    won = (p > threshold) & (p > scores)
    return class_ids.masked_fill(won, class_id), torch.where(won, p, scores)
