"""Limit the threads of libraries where more cost time and save none."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import torch


@contextmanager
def one_processor() -> Iterator[None]:
    """Run this thread, and threads that start within the block, on the processor that runs it now; on Linux only.

    A thread that waits actively by yielding then costs nothing: the threads that it waits for run instead.
    """
    former = None
    with suppress(OSError, AttributeError):  # AttributeError: other systems
        former = os.sched_getaffinity(0)
        os.sched_setaffinity(0, {ctypes.CDLL(None).sched_getcpu()})
    try:
        yield
    finally:
        if former is not None:
            with suppress(OSError):  # Those processors may have been taken away meanwhile.
                os.sched_setaffinity(0, former)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run torch's operations on one thread: waking others takes longer than many small operations do."""
    former = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(former)
