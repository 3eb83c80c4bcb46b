"""Commands in forked processes, which need not import everything again, and their end by SIGKILL (Linux)."""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path

from beags_plugin.child_processes import end_with_parent


def forked(call: Callable[[], object], log: Path) -> int:
    """Start ``call`` in a process of its own, which prints to ``log``; returns its process id.

    It ends with exit code 0 if the call returns, 1 if it raises, or the code that it asks for. This process must not
    have computed anything: threads do not survive a fork.
    """
    parent = os.getpid()
    child = os.fork()
    if child > 0:
        return child
    code = 1
    try:
        end_with_parent(signal.SIGKILL, parent)
        with open(log, "ab") as out, open(os.devnull) as nothing:
            for target, source in ((0, nothing), (1, out), (2, out)):
                os.dup2(source.fileno(), target)
        call()
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # an interrupt too must not go on in the loop of the parent
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(child: int) -> int | None:
    """The exit code of a child, negative for a signal; None while it runs. Asked once after the end."""
    found, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def run(call: Callable[[], object], log: Path) -> int:
    """Start ``call`` and wait for its end; returns its exit code."""
    return os.waitstatus_to_exitcode(os.waitpid(forked(call, log), 0)[1])


def kill_when(
    call: Callable[[], object], log: Path, cpu_seconds: float, there: Callable[[], bool] = lambda: True
) -> tuple[int, float]:
    """Start ``call`` and kill it once it has had so much CPU time and ``there`` says so.

    Returns its exit code (-9: killed) and its CPU time.
    """
    child, used = forked(call, log), 0.0
    while (code := ended(child)) is None:
        used = max(used, cpu_time(child))
        if used < cpu_seconds:
            time.sleep(0.002)
        elif not there():
            time.sleep(0.0002)  # what is waited for may last a millisecond
        else:
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), used
    return code, used


def cpu_time(child: int) -> float:
    """Seconds of CPU time that a process has had: a moment in a run, however busy the machine is."""
    try:
        fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
