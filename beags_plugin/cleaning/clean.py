"""Gaussians that do not belong to their object: spikes that leave its masks, and parts that no mask supports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beags_plugin.cleaning.parts import GAP, connected_parts
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.surfels import Surfels

OUTSIDE = 0.2  # share of a Gaussian's weight outside the masks above which it may be left out
CHIP = 0.005  # share of an object's weight inside its masks below which a part far from it may be a chip
SPECK = 0.002  # the same share below which it is a chip whatever the masks say
CHIP_SUPPORT = 2.0  # least ratio of a part's weight inside the masks to that outside and hidden, unless it is a chip
FAR = 0.1  # distance of a chip from all else, over the object's longest side
MOST = 0.5  # largest share of an object's Gaussians to leave out; beyond it, masks and object contradict each other


@dataclass(frozen=True)
class LeftOut:
    """The numbers of an object's Gaussians that were left out.

    outside: those that reach outside its masks. loose: those of detached parts that no mask supports. doubt: why this
    could not be decided, so that none was left out, or "".
    """

    outside: int = 0
    loose: int = 0
    doubt: str = ""

    def __str__(self) -> str:
        """Return a phrase for users: how many Gaussians were left out, and why."""
        outside = [f"{self.outside} that reach outside its masks"] if self.outside else []
        loose = [f"{self.loose} in specks and loose parts that hardly any mask supports"] if self.loose else []
        if outside or loose:
            return f"{' and '.join(outside + loose)} left out"
        return f"nothing left out, as {self.doubt}" if self.doubt else "nothing left out"


def clean(part: Surfels, class_id: int, views: MaskedViews) -> tuple[Tensor, LeftOut]:
    """Return the Gaussians of an object that belong to it by the masks of training views, and how many do not.

    This is our extension. The object is rendered alone. A Gaussian is a spike if a fifth or more of its weight lies
    outside the masks, where nothing hides it; it is left out unless that opens more pixels in the masks than it clears
    beside them. Of the rest, connected parts (``connected_parts``) are left out if they have no more weight inside the
    masks than outside; the part with the most weight inside stays. Parts far from it with hardly any of the weight
    inside, and less than twice as much as outside and hidden, are errors that a few masks share: they are left out too,
    as is a part far from it with next to none.

    part: M Gaussians of class ``class_id``, in the frame of the views. If more than half of them would be left out,
    none is. Returns indices [K] int64, ascending, and the numbers left out.
    """
    evidence = views.evidence(part, class_id)
    inside, outside, _, beside = evidence.T
    spikes = (outside > 0) & (outside >= OUTSIDE * (inside + beside + outside))
    if spikes.any():
        holes, cleared = views.flips(part, part[torch.from_numpy(~spikes)], class_id).T
        spikes &= holes <= cleared
    dropped = spikes.copy()
    left, parts, (within, beyond, behind) = _weighed_parts(part, evidence, dropped)
    loose = (within <= beyond) & (beyond + behind > 0)
    if len(within):
        loose[within.argmax()] = False
    dropped[left[loose[parts]]] = True
    left, parts, (within, beyond, behind) = _weighed_parts(part, evidence, dropped, FAR)
    if len(within):
        unsupported = (within < CHIP * within.sum()) & (within < CHIP_SUPPORT * (beyond + behind))
        chips = unsupported | (within < SPECK * within.sum())
        chips[within.argmax()] = False
        dropped[left[chips[parts]]] = True
    if dropped.sum() > MOST * len(part):
        doubt = f"its masks contradict {int(dropped.sum())} of its {len(part)} Gaussians"
        return torch.arange(len(part)), LeftOut(doubt=doubt)
    keep = torch.from_numpy(np.flatnonzero(~dropped))
    return keep, LeftOut(int(spikes.sum()), int((dropped & ~spikes).sum()))


def _weighed_parts(
    part: Surfels, evidence: np.ndarray, dropped: np.ndarray, gap: float = GAP
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
    """Return the Gaussians not ``dropped``, their parts, and the weight of each part inside, outside and hidden."""
    left = np.flatnonzero(~dropped)
    parts = connected_parts(part[torch.from_numpy(left)], gap)
    left, parts = left[parts >= 0], parts[parts >= 0]
    return left, parts, [np.bincount(parts, evidence[left, column]) for column in range(3)]
