"""Locks that let one process at a time work in a folder: a training in its run, ``beags process`` in its scene."""

from __future__ import annotations

from pathlib import Path
from weakref import WeakValueDictionary

from filelock import BaseFileLock, FileLock, Timeout

from beags_plugin.system.errors import UserError, writing

LOCK = ".lock"
"""Name of the file that the process working in a folder locks; a file that nobody locks means nothing."""

_held: WeakValueDictionary[Path, BaseFileLock] = WeakValueDictionary()  # locks that this process holds
_ahead: dict[Path, BaseFileLock] = {}


def lock_ahead(run: Path) -> None:
    """Lock ``run`` for a training of this process that has not begun yet; ``run_lock`` takes the lock over.

    Raises ``UserError`` if another process holds it.
    """
    held = _held.get(run.absolute())
    if held is None or not held.is_locked:
        _ahead[run.absolute()] = run_lock(run)


def run_lock(run: Path, doing: str = "being trained") -> BaseFileLock:
    """Lock a run's folder until ``release()`` is called or the process ends.

    doing: what another process does with the folder, for the sentence. Raises ``UserError`` if one holds the lock.
    Locks nothing where the system or the disk has no such locks.
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
            if error.filename is not None:  # a named file cannot be opened; some network disks raise without a name
                raise
    _held[run.absolute()] = lock
    return lock
