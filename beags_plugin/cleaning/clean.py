"""What of an object's Gaussians does not belong to it: spikes that leave its masks, and chips that none supports."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from beags_plugin.cleaning.parts import connected_parts
from beags_plugin.cleaning.silhouettes import MaskedViews
from beags_plugin.core.surfels import Surfels

OUTSIDE = 0.2  # share of a Gaussian's weight outside the masks from which on it may be left out
CHIP = 0.005  # share of an object's weight inside its masks below which a part far from it may be a chip
CHIP_SUPPORT = 2.0  # times its weight outside the masks and hidden, which a part inside them has that is no chip
FAR = 0.1  # distance of a chip from all else, over the object's longest side
MOST = 0.5  # share of an object's Gaussians; where more would go, masks and object contradict each other


@dataclass(frozen=True)
class LeftOut:
    """The numbers of an object's Gaussians that were left out.

    outside: those that reach outside its masks. loose: those of parts that hang together with nothing of it and that no
    mask supports. doubt: why none was left out, where that could not be decided, or "".
    """

    outside: int = 0
    loose: int = 0
    doubt: str = ""

    def __str__(self) -> str:
        """Return a phrase for users: how many Gaussians were left out, and why."""
        reasons = [
            f"{count} {why}"
            for count, why in (
                (self.outside, "that reach outside its masks"),
                (self.loose, "in loose parts that hardly any mask supports"),
            )
            if count
        ]
        if reasons:
            return f"{' and '.join(reasons)} left out"
        return f"nothing left out, as {self.doubt}" if self.doubt else "nothing left out"


def clean(part: Surfels, class_id: int, views: MaskedViews) -> tuple[Tensor, LeftOut]:
    """Return [K] int64, ascending, which Gaussians of an object belong to it by the masks of training views, and how
    many do not (our extension).

    The object is drawn alone. A Gaussian may leave its visual hull if it has a fifth or more of its weight outside the
    masks, where nothing hides it; it is left out unless that opens more in the masks than it clears beside them. Of the
    rest, parts that hang together with no other (``connected_parts``) are left out if they have no more weight inside
    the masks than outside; the part with the most weight inside stays. Parts far from it that have next to none of the
    weight inside, and less than twice as much as outside and hidden, are errors that a few masks share: they go too.

    part: M Gaussians of class ``class_id``, in the frame of the views. If more than half of them would go, none does.
    """
    evidence = views.evidence(part, class_id)
    inside, outside, _, beside = evidence.T
    spikes = (outside > 0) & (outside >= OUTSIDE * (inside + beside + outside))
    if spikes.any():
        holes, cleared = views.flips(part, part[torch.from_numpy(~spikes)], class_id).T
        spikes &= holes <= cleared
    left = np.flatnonzero(~spikes)
    parts = connected_parts(part[torch.from_numpy(left)])
    left, parts = left[parts >= 0], parts[parts >= 0]
    within, beyond, behind = (np.bincount(parts, evidence[left, column]) for column in range(3))
    loose = (within <= beyond) & (beyond + behind > 0)
    if len(within):
        loose[within.argmax()] = False
    dropped = spikes.copy()
    dropped[left[loose[parts]]] = True
    dropped |= _chips(part, evidence, dropped)
    if dropped.sum() > MOST * len(part):
        doubt = f"its masks contradict {int(dropped.sum())} of its {len(part)} Gaussians"
        return torch.arange(len(part)), LeftOut(doubt=doubt)
    keep = torch.from_numpy(np.flatnonzero(~dropped))
    return keep, LeftOut(int(spikes.sum()), int((dropped & ~spikes).sum()))


def _chips(part: Surfels, evidence: np.ndarray, dropped: np.ndarray) -> np.ndarray:
    """Return [M] bool, the Gaussians of small parts that lie ``FAR`` from all else; evidence: [M, 4] of the masks."""
    chips = np.zeros(len(part), bool)
    left = np.flatnonzero(~dropped)
    parts = connected_parts(part[torch.from_numpy(left)], FAR)
    left, parts = left[parts >= 0], parts[parts >= 0]
    if len(left):
        within, beyond, behind = (np.bincount(parts, evidence[left, column]) for column in range(3))
        small = (within < CHIP * within.sum()) & (within < CHIP_SUPPORT * (beyond + behind))
        small[within.argmax()] = False
        chips[left[small[parts]]] = True
    return chips
