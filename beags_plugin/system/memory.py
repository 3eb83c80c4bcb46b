"""Memory of this process and of its machine or container, in MB of 10^6 bytes."""

from __future__ import annotations

import ctypes
from contextlib import suppress
from pathlib import Path

import psutil


def memory_mb() -> float:
    """Return the resident memory of this process."""
    return psutil.Process().memory_info().rss / 1e6


def peak_memory_mb() -> float:
    """Return the largest resident memory of this process so far; the present memory on systems other than Linux."""
    with suppress(OSError, StopIteration):  # psutil has no peak; that of getrusage counts the parent process too
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith("VmHWM:")).split()[1]) * 1024 / 1e6
    return memory_mb()


def trim_memory() -> None:
    """Give freed memory back to the system, of which glibc keeps most; does nothing with other C libraries."""
    with suppress(OSError, AttributeError, TypeError):  # TypeError: Windows has no such library
        ctypes.CDLL(None).malloc_trim(0)


def available_mb() -> float:
    """Return the memory that this process may still take, by the machine and by the limits of its container."""
    return max(min([psutil.virtual_memory().available / 1e6, *_free_in_groups()]), 0.0)


def _free_in_groups() -> list[float]:
    """Return the memory left by each limit of the process's control groups (version 2); inactive file cache is free."""
    free = []
    with suppress(OSError):
        own = Path("/proc/self/cgroup").read_text().strip().rpartition("::")[2].lstrip("/")
        groups = Path("/sys/fs/cgroup", own)
        for group in (groups, *groups.parents):
            with suppress(OSError, ValueError):
                limit = int((group / "memory.max").read_text())  # "max" is no number and means no limit
                used = int((group / "memory.current").read_text())
                stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
                free.append((limit - used + int(stat.get("inactive_file", 0))) / 1e6)
    return free
