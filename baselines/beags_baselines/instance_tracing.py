"""Trace3D's instance tracing: which Gaussians straddle objects, when they are split and pruned, and whose they are.

Shen, Ni, Chen, Li, Pei, Huang, "Trace3D: Consistent Segmentation Lifting via Gaussian Instance Tracing", ICCV 2025.
With n[i,c,v] the pixels of class c in view v in which Gaussian i is composited, however faintly, view v

    sees i               iff  sum_c n[i,c,v] > 25,
    finds it ambiguous   iff  it sees it and  max_c n[i,c,v] / (sum_c n[i,c,v] + 1e-6) < 0.8,

S_i and A_i being the numbers of these views. In four cycles every i with A_i / (S_i + 1e-6) > 0.4 is split in two,
all views are traced again, and what is still ambiguous is pruned, while the photos train on. In the end i belongs to
object c iff sum_v n[i,c,v] / sum_c',v n[i,c',v] > 0.66. Counts are of labelled pixels, background being a class.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, get_args

import torch
from torch import Tensor

from beags_plugin.system.errors import check_choice

MIN_PIXELS = 25
"""Labelled pixels of a view that a Gaussian must exceed to be seen there, whatever the size of the photos."""
MIN_SHARE = 0.8
"""Share of a view's pixels below which the largest class leaves a Gaussian ambiguous in that view."""
MAX_AMBIGUOUS = 0.4
"""Part of the views that see a Gaussian beyond which it is split, or pruned."""
MEMBER_SHARE = 0.66
"""Share of its pixels in all views that makes a Gaussian a member of an object."""
STEPS = 9_000
"""Training steps; the cycles move with them."""
PositionRate = Literal["released", "intended"]
POSITION_RATE: PositionRate = "released"
"""Learning rate of the centres: "released", 0, as the source's script has it by loading the scene from a .ply, or
"intended", the base's schedule from its start."""

FIRST_CYCLE, INTERVAL, CYCLES = 10, 1_200, 4  # of 9,000 steps
RATES, RATE_STEPS = (1.6e-4, 1.6e-6), 30_000  # of the base's schedule, which 9,000 steps do not finish


class InstanceTracing:
    """Counts, for N Gaussians, the views that see them and those that find them ambiguous: S and A, [N] int32."""

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

        keys: [M] int64, i * num_classes + c, each at most once. counts: [M], pixels or, for weights, their sums.
        """
        rows, values = keys // num_classes, counts.float()  # as the source; exact below 2^24 pixels
        zeros = torch.zeros_like(self.seen, dtype=torch.float32)
        total = zeros.index_add(0, rows, values)
        largest = zeros.scatter_reduce(0, rows, values, "amax")
        seen = total > min_pixels
        self.seen += seen
        self.ambiguous_in += seen & (largest / (total + 1e-6) < min_share)

    def ambiguous(self, max_ambiguous: float = MAX_AMBIGUOUS) -> Tensor:
        """Return which Gaussians too many of the views that see them find ambiguous, [N] bool."""
        return self.ambiguous_in / (self.seen + 1e-6) > max_ambiguous


def members(counts: Tensor, totals: Tensor, member_share: float = MEMBER_SHARE) -> Tensor:
    """Return which of N Gaussians belong to one object, [N] bool; never-seen ones do not.

    counts: [N] pixels of the object in all views in which they are composited. totals: [N], those of all classes.
    """
    return counts.double() / totals.double().clamp_min(1e-9) > member_share


def never_composited(views: Iterable[Tensor], count: int, device: torch.device | str = "cpu") -> Tensor:
    """Return which of N Gaussians no view composites, [N] bool: they are pruned at the first and the last step.

    views: of each the Gaussians [M] int64 that it composites at any pixel, labelled or not.
    """
    missing = torch.ones(count, dtype=torch.bool, device=device)
    for indices in views:
        missing[indices] = False
    return missing


def cycle_steps(steps: int = STEPS) -> list[int]:
    """Return the steps, counted from 1, after whose backward pass a cycle runs in a run of this many."""
    first, interval = (max(round(stated * steps / STEPS), 1) for stated in (FIRST_CYCLE, INTERVAL))
    return [step for step in range(first, first + CYCLES * interval, interval) if step < steps]


def position_rate(step: int, extent: float, steps: int = STEPS, schedule: PositionRate = POSITION_RATE) -> float:
    """Return the learning rate of the centres at a step, 1..steps, in world units of a scene of this extent."""
    check_choice(schedule, get_args(PositionRate), "schedule of the positions")
    if schedule == "released":
        return 0.0
    start, end = map(math.log, RATES)
    return extent * math.exp(start + (end - start) * step * (STEPS / steps) / RATE_STEPS)
