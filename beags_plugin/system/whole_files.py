"""Files that are there whole or not at all, whenever the program is killed."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from beags_plugin.system.errors import writing

PART = ".part"
"""Ends the names of files that are being written; their names start with a dot."""


def write_whole(path: Path, write: Callable[[BinaryIO], Any], beside: Path | None = None) -> None:
    """Let ``write`` write a file that takes the place of ``path`` once it is safe on disk.

    beside: folder of the unfinished file, on the same disk; that of ``path`` if None. Raises ``UserError`` if the
    system does not let it: the disk is full, or nothing may be written there.
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
                part.unlink(missing_ok=True)  # it may be what fills the disk
            raise


def write_text_atomically(text: str, path: Path) -> None:
    """Write UTF-8 text as ``write_whole`` does."""
    write_whole(path, lambda file: file.write(text.encode("utf8")))


def unfinished(path: Path, beside: Path | None = None) -> Path:
    """Return the path where ``path`` is written first; beside: see ``write_whole``."""
    return (beside or path.parent) / f".{path.name}{PART}"


def put_in_place(part: Path, path: Path) -> None:
    """Bring a file that has been written safely to disk, and let it take the place of ``path``."""
    with open(part, "rb+") as file:
        os.fsync(file.fileno())
    os.replace(part, path)
    _sync_folder(path.parent)


def remove_unfinished(
    folder: Path, below: bool = True, older: float = 0.0, ends: tuple[str, ...] = ("",)
) -> list[Path]:
    """Remove what a killed program left half written in ``folder``, and with ``below`` in the folders below it.

    older: only files to which nothing was written for so many seconds, where another process may be writing; 0: all.
    ends: how the names of the whole files end, where other programs may write too. Returns the files.
    """
    latest, found = time.time() - older, []
    for path in sorted((folder.rglob if below else folder.glob)(f".*{PART}")):
        with suppress(FileNotFoundError):  # another process has put it in its place
            named = path.name.removesuffix(PART).endswith(ends)
            if named and path.is_file() and (not older or path.stat().st_mtime <= latest):
                path.unlink()
                found.append(path)
    return found


def _sync_folder(folder: Path) -> None:
    """Make a new name in ``folder`` survive a power cut; not every system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return
    try:
        os.fsync(handle)
    except OSError:
        pass
    finally:
        os.close(handle)
