"""Files that are written whole or not at all, even if the program is killed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from beags_plugin.system.errors import writing

PART = ".part"
"""End of the names of unfinished files; these names also start with a dot."""


def write_whole(path: Path, write: Callable[[BinaryIO], Any], beside: Path | None = None) -> None:
    """Let ``write`` write a file, and move it to ``path`` once it is safe on disk.

    beside: folder of the unfinished file, on the same disk; the folder of ``path`` if None. Raises ``UserError`` if the
    disk is full or the folder may not be written to.
    """
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        part = unfinished(path, beside)
        try:
            with open(part, "wb") as file:
                write(file)
            put_in_place(part, path)
        except (Exception, KeyboardInterrupt):
            with suppress(OSError):
                part.unlink(missing_ok=True)  # the unfinished file may be what fills the disk
            raise


def write_text_atomically(text: str, path: Path) -> None:
    """Write UTF-8 text as ``write_whole`` does."""
    write_whole(path, lambda file: file.write(text.encode("utf8")))


def unfinished(path: Path, beside: Path | None = None) -> Path:
    """Return where the unfinished file for ``path`` is written; beside: see ``write_whole``."""
    return (beside or path.parent) / f".{path.name}{PART}"


def put_in_place(part: Path, path: Path) -> None:
    """Flush a written file to disk and move it to ``path``."""
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)
    _sync_folder(path.parent)


def remove_unfinished(
    folder: Path, below: bool = True, older: float = 0.0, ends: tuple[str, ...] = ("",)
) -> list[Path]:
    """Remove unfinished files of killed programs from ``folder``, with ``below`` also from the folders below it.

    older: seconds without a write after which a file counts as unfinished, for folders where another process may be
    writing; 0 removes all. ends: only files whose finished names end so, for folders that other programs use too.
    Returns the removed files.
    """
    latest, removed = time.time() - older, []
    for path in sorted((folder.rglob if below else folder.glob)(f".*{PART}")):
        with suppress(FileNotFoundError):  # another process has finished it
            named = path.name.removesuffix(PART).endswith(ends)
            if named and path.is_file() and (not older or path.stat().st_mtime <= latest):
                path.unlink()
                removed.append(path)
    return removed


def _sync_folder(folder: Path) -> None:
    """Make a new name in ``folder`` survive a power cut, where the system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return
    with suppress(OSError):
        os.fsync(handle)
    os.close(handle)
