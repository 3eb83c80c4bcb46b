"""Memory of this process."""

from __future__ import annotations

import resource
from contextlib import suppress
from pathlib import Path


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB of 10^6 bytes."""
    found = _status("VmHWM:")  # getrusage's would count what the parent process once held
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6 if found is None else found


def memory_mb() -> float:
    """Resident memory of this process now, MB of 10^6 bytes; the largest so far where the system does not say."""
    found = _status("VmRSS:")
    return peak_memory_mb() if found is None else found


def available_mb() -> float | None:
    """Memory that this process may still take, MB of 10^6 bytes, here and in the control groups that it is in.

    None where the system does not say (it is not Linux).
    """
    with suppress(OSError, StopIteration, ValueError):
        info = Path("/proc/meminfo").read_text().splitlines()
        free = int(next(line for line in info if line.startswith("MemAvailable:")).split()[1]) * 1024 / 1e6
        return max(min([free, *_free_in_groups()]), 0.0)
    return None


def _free_in_groups() -> list[float]:
    """What the limits of the control groups (version 2) of this process leave, MB; pages that can be dropped count."""
    found = []
    with suppress(OSError):
        own = Path("/proc/self/cgroup").read_text().strip().rpartition("::")[2].lstrip("/")
        groups = Path("/sys/fs/cgroup", own)
        for group in (groups, *groups.parents):
            with suppress(OSError, ValueError):
                limit = int((group / "memory.max").read_text())  # "max" is no number: no limit
                used = int((group / "memory.current").read_text())
                stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
                found.append((limit - used + int(stat.get("inactive_file", 0))) / 1e6)
    return found


def _status(name: str) -> float | None:
    with suppress(OSError, StopIteration):  # Linux only
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith(name)).split()[1]) * 1024 / 1e6
    return None
