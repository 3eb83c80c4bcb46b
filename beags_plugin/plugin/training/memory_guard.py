"""Check that memory and disk are free, before a run and while it trains."""

from __future__ import annotations

import errno
import shutil
import tempfile
from pathlib import Path

from beags_plugin.system.errors import UserError
from beags_plugin.system.memory import available_mb, memory_mb

LEAST_FREE_MB = 200.0
"""Memory, and space on each disk, that must be free to begin and to go on training; MB of 10^6 bytes."""

SMALLER = (
    "train with smaller photos (end the command with beags-data --downscale-factor 2), or bound the Gaussians "
    "(--pipeline.model.densify.pixels-per-surfel 100)"
)

NO_MEMORY = f"memory ran out before anything was saved: close other programs, or {SMALLER}."

_ANYWAY = "or try it all the same with --check-memory False (beags resume: --no-check-memory)."


def check_room(run: Path, device: str) -> None:
    """Raise ``UserError`` if hardly any memory or disk is free.

    run: folder of the run. device: memory is checked for "cpu" alone.
    """
    if device == "cpu" and (left := available_mb()) < LEAST_FREE_MB:
        raise UserError(f"the machine has {left:.0f} MB of memory left: close other programs, {SMALLER}, {_ANYWAY}")
    temporary = Path(tempfile.gettempdir())
    for folder, remedy in ((run, "another folder with --run-dir"), (temporary, "one for temporary files with TMPDIR")):
        if (free := free_disk_mb(folder)) < LEAST_FREE_MB:
            sentence = f"the disk of {folder} has {free:.0f} MB left: free some space, choose {remedy}"
            raise UserError(f"{sentence}, {_ANYWAY}")


def free_disk_mb(folder: Path) -> float:
    """Return the free space on the disk of a folder, which need not exist yet; MB of 10^6 bytes."""
    existing = next(parent for parent in (folder.absolute(), *folder.absolute().parents) if parent.exists())
    return shutil.disk_usage(existing).free / 1e6


class MemoryWatch:
    """Watches memory, so that a training can be saved before it runs out."""

    EVERY = 20  # Steps between two checks.

    def __init__(self, device: str) -> None:
        self._on = device == "cpu"

    def short_of(self, step: int) -> str | None:
        """Describe the shortage of memory after ``step``; None if there is enough."""
        if not self._on or step % self.EVERY or (left := available_mb()) >= LEAST_FREE_MB:
            return None
        return f"the machine has {left:.0f} MB of memory left, and this training takes {memory_mb():.0f} MB"


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether memory ran out, as Python, the compiled code, or torch on a CPU or a GPU reports it."""
    if isinstance(error, RuntimeError):
        words = ("can't allocate memory", "Cannot allocate memory", "out of memory")
        return any(each in str(error) for each in words)
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
