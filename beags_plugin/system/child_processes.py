"""Child processes that end with their parent, also when the parent is killed (Linux; elsewhere nothing is done).

``python system/child_processes.py PARENT SIGNAL COMMAND...`` asks the kernel to send the signal when the parent
ends, and becomes the command.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def end_with_parent(kind: signal.Signals = signal.SIGTERM, parent: int | None = None) -> None:
    """Let the kernel send this process a signal when the thread that started it ends.

    parent: the process id that the parent should have; it may have ended before this call.
    """
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(kind))
    if parent is not None and os.getppid() != parent:
        os.kill(os.getpid(), kind)


def bound(command: Sequence[object], kind: signal.Signals = signal.SIGTERM) -> list[str]:
    """Return a command line that runs ``command`` in a process that gets a signal when this thread ends."""
    words = [str(word) for word in command]
    if sys.platform != "linux":
        return words
    return [sys.executable, "-I", "-S", str(Path(__file__).resolve()), str(os.getpid()), str(int(kind)), *words]


if __name__ == "__main__":
    end_with_parent(signal.Signals(int(sys.argv[2])), int(sys.argv[1]))
    os.execvp(sys.argv[3], sys.argv[3:])
