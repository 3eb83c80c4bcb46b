"""Agreement between the processes of ``torch.distributed``, where there are several.

All processes must call these functions, with tensors of the same shapes. Alone, a process changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

Result = TypeVar("Result")


def size() -> int:
    """Return the number of processes."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Return the number of this process, from 0."""
    return dist.get_rank() if size() > 1 else 0


def is_first() -> bool:
    """Return whether this process is the only one, or the first of its group."""
    return rank() == 0


def add_up(tensors: Iterable[Tensor]) -> None:
    """Put the sum over all processes into each tensor, the same bits in all of them."""
    if size() > 1:
        for tensor in tensors:
            dist.all_reduce(tensor, group=_group(tensor.device))


def average(tensors: Iterable[Tensor]) -> None:
    """Put the mean over all processes into each float tensor, the same bits in all of them."""
    if size() > 1:
        tensors = list(tensors)
        add_up(tensors)
        for tensor in tensors:
            tensor /= size()


def take_from_first(tensors: Iterable[Tensor]) -> None:
    """Copy the first process's values into each tensor."""
    if size() > 1:
        for tensor in tensors:
            dist.broadcast(tensor, src=0, group=_group(tensor.device))


def in_any(yes: bool) -> bool:
    """Return whether ``yes`` holds in any process; waits for the other processes, not for a GPU."""
    if size() > 1:
        flag = torch.tensor(int(yes))
        dist.all_reduce(flag, op=dist.ReduceOp.MAX, group=_group(flag.device))
        return bool(flag)
    return yes


_host_groups: dict[Any, Any] = {}


def _group(device: torch.device) -> Any:
    """Return the group that exchanges tensors of a device: NCCL, which GPUs may use, takes none on a CPU."""
    if device.type != "cpu" or dist.get_backend() != "nccl":
        return None
    world = dist.group.WORLD
    if world not in _host_groups:
        _host_groups.clear()
        _host_groups[world] = dist.new_group(backend="gloo")
    return _host_groups[world]


def each_view(
    count: int, work: Callable[[int], Result], progress: Callable[[int, int], None] | None = None
) -> Iterator[Result]:
    """Yield ``work(0)``, .., ``work(count - 1)``, one after the other, as they are asked for.

    Each of several processes does all of it for itself and gets the same bits: nothing is exchanged.
    progress: called with (done, count).
    """
    for index in range(count):
        result = work(index)
        if progress:
            progress(index + 1, count)
        yield result
