"""Digests of inputs: if they are unchanged, a result made from them earlier is still valid."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]
_SHOWING = "commands"  # this room only prints and draws what the rest has computed


def code_digest(*more: Path) -> str:
    """Digest every file of the package that can change a result, with the compiled extension, and ``more`` files."""
    digest = hashlib.sha256()
    for path in sorted([*_PACKAGE.rglob("*.py"), *_PACKAGE.glob("_native*"), *_PACKAGE.glob("native/**/*")]):
        if path.is_file() and path.relative_to(_PACKAGE).parts[0] != _SHOWING:
            digest.update(path.read_bytes())
    for path in more:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def folder_digest(folder: Path, without: Path | None = None, names: Collection[str] = ()) -> str:
    """Digest path, size and time of every file of ``folder`` whose name has no leading dot, as those of locks have.

    without: a folder whose content does not count, such as results made from the files. names: names of files and
    folders in ``folder`` that do not count either.
    """
    digest = hashlib.sha256(str(folder.resolve()).encode())
    left_out = None if without is None else without.resolve()
    for path in sorted(path for path in folder.rglob("[!.]*") if path.is_file()):
        counts = left_out is None or not path.resolve().is_relative_to(left_out)
        if counts and path.relative_to(folder).parts[0] not in names:
            stat = path.stat()
            digest.update(f"{path.relative_to(folder)} {stat.st_size} {stat.st_mtime_ns}".encode())
    return digest.hexdigest()


def content_digest(files: Iterable[Path]) -> str:
    """Digest name and content of every file."""
    digest = hashlib.sha256()
    for path in files:
        content = path.read_bytes()
        digest.update(f"{path.name} {len(content)} ".encode() + content)
    return digest.hexdigest()


def value_digest(value: Any) -> str:
    """Digest plain values (JSON), whatever the order of a dict's keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
