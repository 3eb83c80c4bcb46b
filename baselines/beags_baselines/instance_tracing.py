"""Trace3D's instance tracing: detection of Gaussians that straddle objects, cycles of splitting, and members.

Shen, Ni, Chen, Li, Pei, Huang, "Trace3D: Consistent Segmentation Lifting via Gaussian Instance Tracing", ICCV 2025.
With n[i,c,v] the pixels of class c in view v in which Gaussian i is composited, however faintly, view v

    sees i               iff  sum_c n[i,c,v] > 25,
    finds it ambiguous   iff  it sees it and  max_c n[i,c,v] / (sum_c n[i,c,v] + 1e-6) < 0.8,

where S_i and A_i are the numbers of these views. In four cycles during training every i with A_i / (S_i + 1e-6) > 0.4
is split in two, all views are traced again, and Gaussians that are still ambiguous are pruned. At the end i belongs to
object c iff sum_v n[i,c,v] / sum_c',v n[i,c',v] > 0.66. Only labelled pixels count; the background is a class.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, get_args

import torch
from torch import Tensor

from beags_plugin.system.errors import check_choice

MIN_PIXELS = 25
"""Labelled pixels that a Gaussian must exceed to be seen in a view, at any size of photos."""
MIN_SHARE = 0.8
"""Share of a view's pixels below which the largest class leaves a Gaussian ambiguous in that view."""
MAX_AMBIGUOUS = 0.4
"""Share of ambiguous views, of those that see a Gaussian, above which it is split or pruned."""
MEMBER_SHARE = 0.66
"""Share of its pixels in all views that makes a Gaussian a member of an object."""
STEPS = 9_000
"""Training steps of the source; cycles scale with the number of steps."""
PositionRate = Literal["released", "intended"]
POSITION_RATE: PositionRate = "released"
"""Learning rate of the centres: "released", 0, which the source's script has because it loads the scene from a .ply;
"intended", the base's schedule from its start."""

FIRST_CYCLE, INTERVAL, CYCLES = 10, 1_200, 4  # steps of 9,000, and number of cycles
RATES, RATE_STEPS = (1.6e-4, 1.6e-6), 30_000  # the base's schedule, which 9,000 steps do not finish


class InstanceTracing:
    """Counts the views that see N Gaussians and those that find them ambiguous: S and A, [N] int32."""

    def __init__(self, count: int, device: torch.device | str = "cpu") -> None:
        self.seen = torch.zeros(count, dtype=torch.int32, device=device)
        self.ambiguous_in = torch.zeros_like(self.seen)

    def add(
        self,
        keys: Tensor,
        counts: Tensor,
        num_classes: int,
        min_pixels: float = MIN_PIXELS,
        min_share: float = MIN_SHARE,
    ) -> None:
        """Add one view.

        keys: [M] int64, i * num_classes + c, each at most once. counts: [M], numbers of pixels or sums of weights.
        """
        rows, values = keys // num_classes, counts.float()  # float32 as in the source, exact below 2^24 pixels
        zeros = torch.zeros_like(self.seen, dtype=torch.float32)
        total = zeros.index_add(0, rows, values)
        largest = zeros.scatter_reduce(0, rows, values, "amax")
        seen = total > min_pixels
        self.seen += seen
        self.ambiguous_in += seen & (largest / (total + 1e-6) < min_share)

    def ambiguous(self, max_ambiguous: float = MAX_AMBIGUOUS) -> Tensor:
        """Return [N] bool: Gaussians with more than ``max_ambiguous`` of their views ambiguous."""
        return self.ambiguous_in / (self.seen + 1e-6) > max_ambiguous


def members(counts: Tensor, totals: Tensor, member_share: float = MEMBER_SHARE) -> Tensor:
    """Return the Gaussians of one object, [N] bool; a Gaussian that is never seen is in none.

    counts: [N], pixels of the object in which a Gaussian is composited, all views. totals: [N], those of all classes.
    """
    return counts.double() / totals.double().clamp_min(1e-9) > member_share


def never_composited(views: Iterable[Tensor], count: int, device: torch.device | str = "cpu") -> Tensor:
    """Return the Gaussians that no view composites, [N] bool: they are pruned at the first and the last step.

    views: for each, the Gaussians [M] int64 that it composites at any pixel, labelled or not.
    """
    missing = torch.ones(count, dtype=torch.bool, device=device)
    for indices in views:
        missing[indices] = False
    return missing


def cycle_steps(steps: int = STEPS) -> list[int]:
    """Return the steps, counted from 1, after whose backward pass a cycle runs, in a run of ``steps``."""
    first, interval = (max(round(stated * steps / STEPS), 1) for stated in (FIRST_CYCLE, INTERVAL))
    return [step for step in range(first, first + CYCLES * interval, interval) if step < steps]


def position_rate(step: int, extent: float, steps: int = STEPS, schedule: PositionRate = POSITION_RATE) -> float:
    """Return the learning rate of the centres at a step, 1..steps, in world units of a scene of this extent."""
    check_choice(schedule, get_args(PositionRate), "schedule of the positions")
    if schedule == "released":
        return 0.0
    start, end = map(math.log, RATES)
    return extent * math.exp(start + (end - start) * step * (STEPS / steps) / RATE_STEPS)
