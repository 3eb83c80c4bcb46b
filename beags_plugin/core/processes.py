"""Work on views, split over the processes of ``torch.distributed`` where there are several."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import torch.distributed as dist

Result = TypeVar("Result")


def each_view(
    count: int, work: Callable[[int], Result], progress: Callable[[int, int], None] | None = None
) -> Iterator[Result]:
    """``work(0)``, .., ``work(count - 1)``, in that order, in every process; each call is made in one process only.

    Alone, one after the other, as they are asked for. In a process group of R processes, R views at a time, whose
    results are then exchanged: all processes must ask for all of them, and get the same bits as one process would. The
    results are pickled. Their tensors, alone or in tuples, lists and dicts, travel over the CPU: every process gets
    them where its own ``work`` would have put them, on the CPU or on its own GPU. Other objects must hold no tensors
    on a GPU.

    What ``work`` raises in one process is raised in all.

    progress: called with how many are done and ``count``.
    """
    processes = dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1
    if processes == 1:
        for index in range(count):
            yield _told(work(index), progress, index, count)
        return
    own = dist.get_rank()
    for first in range(0, count, processes):
        mine, failure = None, None
        try:
            mine = work(first + own) if first + own < count else None
        except Exception as error:  # told to all, who would wait forever
            failure = error
        found: list[Any] = [None] * processes
        dist.all_gather_object(found, (mine, failure))
        for _, problem in found:
            if problem is not None:
                raise problem
        results = [result for result, _ in found]
        for index in range(first, min(first + processes, count)):
            yield _told(results[index - first], progress, index, count)


def _told(result: Result, progress: Callable[[int, int], None] | None, index: int, count: int) -> Result:
    if progress:
        progress(index + 1, count)
    return result
