"""One process at a time in a folder: a training in its run's, beags process in its scene's."""

from __future__ import annotations

from pathlib import Path
from weakref import WeakValueDictionary

from filelock import BaseFileLock, FileLock, Timeout

from beags_plugin.system.errors import UserError, writing

LOCK = ".lock"
"""File of a folder, locked by the process that works there; the file alone means nothing."""

_held: WeakValueDictionary[Path, BaseFileLock] = WeakValueDictionary()  # by this process
_ahead: dict[Path, BaseFileLock] = {}


def lock_ahead(run: Path) -> None:
    """Hold ``run`` for a training of this process, which may have yet to begin; ``run_lock`` takes the lock over.

    Raises ``UserError`` if another process holds it.
    """
    held = _held.get(run.absolute())
    if held is None or not held.is_locked:
        _ahead[run.absolute()] = run_lock(run)


def run_lock(run: Path, doing: str = "being trained") -> BaseFileLock:
    """Hold a run's folder until ``release()`` is called or the process ends, however it ends.

    doing: says what another process does with it. Raises ``UserError`` if one holds it. Holds nothing where the system
    or the disk has no such locks.
    """
    if (lock := _ahead.pop(run.absolute(), None)) is not None:
        return lock
    lock = FileLock(run / LOCK, thread_local=False)
    with writing(run):
        run.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire(blocking=False)
        except Timeout:
            raise UserError(f"{run} is {doing} by another process: wait for it, or end it first.") from None
        except OSError as error:
            if error.filename is not None:  # the file cannot be opened; without a name: some network disks
                raise
    _held[run.absolute()] = lock
    return lock
