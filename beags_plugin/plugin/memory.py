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


def _status(name: str) -> float | None:
    with suppress(OSError, StopIteration):  # Linux only
        status = Path("/proc/self/status").read_text().splitlines()
        return int(next(line for line in status if line.startswith(name)).split()[1]) * 1024 / 1e6
    return None
