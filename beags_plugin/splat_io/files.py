"""Files written for a user: they appear whole or not at all, and errors are user errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beags_plugin.system.errors import writing
from beags_plugin.system.whole_files import put_in_place, unfinished


def write_bytes(path: str | Path, content: bytes) -> None:
    """Write a file as ``whole_file`` does."""
    with whole_file(path) as part:
        part.write_bytes(content)


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to, then move the written file into place; makes the folder.

    The old file is never overwritten, because a program may have it mapped. Raises ``UserError`` if the file cannot be
    written.
    """
    path = Path(path)
    part = unfinished(path)
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield part
            put_in_place(part, path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)
