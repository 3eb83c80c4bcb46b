"""Numbers of pairs (a tile and a Gaussian that reaches it) in renders on GPUs.

The GPU counts them. The host guesses the number from earlier renders, to allocate memory before it arrives.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import get_ident

import torch
from torch import Tensor

_FADING = 0.98  # factor per render on the largest number of pairs so far
_SPARE = 1.25  # factor from the expected pairs to the allocated ones
_STEP = 1 << 14  # pairs, or an eighth of the power of two below: few distinct sizes do not fragment torch's allocator

Place = tuple[torch.device, int]  # a GPU and a thread, so that a viewer's renders do not affect a training


class PairCounts:
    """Remembers the largest number of pairs so far, which fades with each render."""

    def __init__(self) -> None:
        self._largest: dict[Place, float] = {}

    def largest(self) -> int:
        """Return the largest number of any GPU and thread; 0 before the first render."""
        return int(max(self._largest.values(), default=0))

    @staticmethod
    def place(device: torch.device) -> Place:
        """Return this thread's place on a GPU."""
        return device, get_ident()

    def guess(self, place: Place) -> float | None:
        """Return the number to expect; None before the first render at this place."""
        return self._largest.get(place)

    def learn(self, place: Place, pairs: int) -> None:
        """Note the number of pairs that a render had."""
        self._largest[place] = max(self._largest.get(place, 0.0) * _FADING, float(pairs))


def start_copy(totals: Tensor) -> Callable[[], list[int]]:
    """Start to copy ``totals`` [2] to the host; return a function that waits for the two numbers."""
    if not totals.is_cuda:
        return totals.tolist
    numbers = torch.empty(2, dtype=torch.int64, pin_memory=True)  # torch reuses pinned memory.
    numbers.copy_(totals, non_blocking=True)
    event = torch.cuda.Event()
    event.record()

    def wait() -> list[int]:
        event.synchronize()
        return numbers.tolist()

    return wait


def capacity_for(pairs: float) -> int:
    """Return the number of pairs to allocate memory for, where ``pairs`` are expected."""
    wanted = int(pairs * _SPARE)
    step = max(1 << max(wanted.bit_length() - 4, 0), _STEP)
    return (wanted // step + 1) * step
