"""Files made for a user: whole or not at all, or a user error."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from beags_plugin.system.errors import writing
from beags_plugin.system.whole_files import put_in_place, unfinished


@contextmanager
def whole_file(path: str | Path) -> Iterator[Path]:
    """Yield a path beside ``path`` to write to, and move what was written into place; makes the folder.

    A program that has the old file mapped must not lose the ground under it. Raises ``UserError`` if the file cannot
    be written.
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
