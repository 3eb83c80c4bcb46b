"""Peak memory that a call adds to its process."""

from __future__ import annotations

import ctypes
import gc
import resource
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path


def peak_mb_of(call: Callable[[], object]) -> float:
    """Return the MB (2^20 bytes) of resident memory that ``call`` adds at its peak.

    On Linux the kernel's high-water mark is reset first. That of getrusage, used on other systems, includes imports and
    the parent process at its start, which would hide a small case.
    """
    gc.collect()
    _give_back_free_memory()
    try:
        Path("/proc/self/clear_refs").write_text("5")
        before, read = _status("VmRSS"), lambda: _status("VmHWM")
    except (OSError, KeyError):
        before, read = _most_so_far(), _most_so_far
    call()
    return max(read() - before, 0) / 2**20


def _status(name: str) -> int:
    """Return the bytes in a line of /proc/self/status."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return 1024 * int(line.split()[1])
    raise KeyError(name)


def _most_so_far() -> int:
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most


def _give_back_free_memory() -> None:
    """Return free memory to the system, so that a call cannot reuse memory that the C library still holds."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
