"""One training at a time in a run's folder."""

from __future__ import annotations

from pathlib import Path
from typing import IO

from beags_plugin.system.errors import UserError, writing

LOCK = ".lock"
"""File of a run's folder, locked by the process that trains there; without one it means nothing."""


class RunLock:
    """Holds a run's folder until it is released or the process ends, however that happens.

    Raises ``UserError`` if another training holds it. Where the system or the disk knows no such locks, nothing is
    held.
    """

    def __init__(self, run: Path) -> None:
        self._file = _locked(run)
        self._run = run.absolute()
        _held.add(self._run)

    def release(self) -> None:
        """Let others train there."""
        if self._file is not None:
            import fcntl

            fcntl.flock(self._file, fcntl.LOCK_UN)  # also where a forked process still has the file open
            self._file.close()
            self._file = None
        _held.discard(self._run)


_held: set[Path] = set()  # by this process
_ahead: dict[Path, RunLock] = {}


def lock_ahead(run: Path) -> None:
    """Hold ``run`` for a training of this process, which may have yet to begin: see ``run_lock``.

    Raises ``UserError`` if another process holds it.
    """
    if run.absolute() not in _held:
        _ahead[run.absolute()] = RunLock(run)


def run_lock(run: Path) -> RunLock:
    """The lock of ``run``, which this process may hold ahead of its training. Raises ``UserError``."""
    return _ahead.pop(run.absolute(), None) or RunLock(run)


def _locked(run: Path) -> IO[bytes] | None:
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    with writing(run):
        run.mkdir(parents=True, exist_ok=True)
        file = open(run / LOCK, "ab")  # noqa: SIM115  (open as long as the lock is held)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        raise UserError(f"{run} is being trained by another process: wait for it, or end it first.") from None
    except OSError:  # some network disks
        file.close()
        return None
    return file
