"""Work on views, split over the processes of ``torch.distributed`` where there are several, and what they agree on.

What the functions here are given must be of the same kind in all processes, and all must call them. Alone, they do
nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

Result = TypeVar("Result")


def size() -> int:
    """How many processes there are."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """The number of this one, from 0."""
    return dist.get_rank() if size() > 1 else 0


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
    """Put what the first process has into each tensor."""
    if size() > 1:
        for tensor in tensors:
            dist.broadcast(tensor, src=0, group=_group(tensor.device))


def in_any(yes: bool) -> bool:
    """Whether it is so in any process; the host waits for all hosts, not for a GPU."""
    if size() > 1:
        flag = torch.tensor(int(yes))
        dist.all_reduce(flag, op=dist.ReduceOp.MAX, group=_group(flag.device))
        return bool(flag)
    return yes


_host_groups: dict[Any, Any] = {}


def _group(device: torch.device) -> Any:
    """What exchanges tensors there: GPUs may talk through NCCL, which knows none on a CPU."""
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
    """``work(0)``, .., ``work(count - 1)``, in that order, in every process; each call is made in one process only.

    Alone, one after the other, as they are asked for. In a process group of R processes, R views at a time, whose
    results are then exchanged: all processes must ask for all of them, and get the same bits as one process would. The
    results are pickled. Their tensors, alone or in tuples, lists and dicts, travel over the CPU: every process gets
    them where its own ``work`` would have put them, on the CPU or on its own GPU. Other objects must hold no tensors
    on a GPU.

    What ``work`` raises in one process is raised in all.

    progress: called with how many are done and ``count``.
    """
    processes = size()
    if processes == 1:
        for index in range(count):
            yield _told(work(index), progress, index, count)
        return
    own, device = dist.get_rank(), None
    for first in range(0, count, processes):
        mine, failure = None, None
        try:
            mine = work(first + own) if first + own < count else None
            device = device or _gpu_of(mine)
        except Exception as error:  # told to all, who would wait forever
            failure = error
        found: list[Any] = [None] * processes
        dist.all_gather_object(found, (_packed(mine), failure), group=_group(torch.device("cpu")))
        for _, problem in found:
            if problem is not None:
                raise problem
        results: list[Any] = [
            mine if rank == own else _unpacked(result, device) for rank, (result, _) in enumerate(found)
        ]
        for index in range(first, min(first + processes, count)):
            yield _told(results[index - first], progress, index, count)


def is_first() -> bool:
    """Whether this process is the only one, or the first of its group."""
    return not (dist.is_available() and dist.is_initialized()) or dist.get_rank() == 0


def _told(result: Result, progress: Callable[[int, int], None] | None, index: int, count: int) -> Result:
    if progress:
        progress(index + 1, count)
    return result


@dataclass(frozen=True)
class _FromGpu:
    """A tensor of a GPU while it travels: a copy on the CPU."""

    values: Tensor


def _packed(result: Any) -> Any:
    return _each_tensor(result, Tensor, lambda tensor: tensor if tensor.is_cpu else _FromGpu(tensor.cpu()))


def _unpacked(result: Any, device: torch.device | None) -> Any:
    """device: the GPU of this process; None: torch's current one, for a process that has had no view yet."""
    return _each_tensor(result, _FromGpu, lambda sent: sent.values.to(device or torch.device("cuda")))


def _gpu_of(result: Any) -> torch.device | None:
    """Where the first tensor lies that is not on the CPU."""
    devices: list[torch.device] = []
    _each_tensor(result, Tensor, lambda tensor: devices.append(tensor.device))
    return next((device for device in devices if device.type != "cpu"), None)


def _each_tensor(result: Any, kind: type, change: Callable[[Any], Any]) -> Any:
    """``result`` with ``change`` of every object of the kind in it, down through tuples, lists and dicts."""
    if isinstance(result, kind):
        return change(result)
    if isinstance(result, dict):
        return {key: _each_tensor(value, kind, change) for key, value in result.items()}
    if isinstance(result, (tuple, list)):
        parts = [_each_tensor(value, kind, change) for value in result]
        return type(result)(*parts) if hasattr(result, "_fields") else type(result)(parts)
    return result
