"""Folders as bytes, for nodes that do not share them, and the paths in their configs."""

from __future__ import annotations

import dataclasses
import io
import os
import shutil
import tarfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from beags_plugin.system.errors import writing
from beags_plugin.system.whole_files import write_text_atomically


def pack(folder: Path, only: Collection[str] = ()) -> bytes:
    """Return a folder as an uncompressed tar file without locks; photos and checkpoints hardly compress.

    only: names of the files to pack; all if empty.
    """
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for path in sorted(folder.rglob("[!.]*")):
            if path.is_file() and (not only or str(path.relative_to(folder)) in only):
                tar.add(path.resolve(), path.relative_to(folder).as_posix(), recursive=False)
    return buffer.getvalue()


def unpack(parcel: bytes, folder: Path) -> None:
    """Replace ``folder`` by the content of a parcel of ``pack``; raises ``UserError`` if it cannot be written."""
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    with writing(folder):
        shutil.rmtree(part, ignore_errors=True)
        try:
            part.mkdir(parents=True)
            with tarfile.open(fileobj=io.BytesIO(parcel)) as tar:
                tar.extraction_filter = getattr(
                    tarfile, "data_filter", None
                )  # missing in early versions of Python 3.10
                tar.extractall(part)
            if folder.exists():
                shutil.rmtree(folder)
            part.rename(folder)
        finally:
            shutil.rmtree(part, ignore_errors=True)  # the rest of a failed attempt


def relocate(folder: Path, moved: Mapping[Path, Path]) -> None:
    """Change paths in the configs of the runs below ``folder``. moved: old folder to new folder."""
    from beags_plugin.plugin.options.config import CONFIG_FILE, config_text
    from beags_plugin.plugin.options.saved_config import load_run_config

    if not moved:
        return
    moved = dict(sorted(moved.items(), key=lambda pair: -len(pair[0].parts)))  # inner folders come first
    for path in sorted(folder.rglob(CONFIG_FILE)):
        write_text_atomically(config_text(_relocated(load_run_config(path), moved)), path)


def _relocated(value: Any, moved: Mapping[Path, Path]) -> Any:
    """Return a config's value with its paths moved; dataclasses are changed in place."""
    if isinstance(value, Path):
        for old, new in moved.items():
            if value.is_relative_to(old):
                return new / value.relative_to(old)
    elif isinstance(value, dict):
        return {key: _relocated(each, moved) for key, each in value.items()}
    elif isinstance(value, (list, tuple)):
        return type(value)(_relocated(each, moved) for each in value)
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for name, each in vars(value).items():
            value.__dict__[name] = _relocated(each, moved)
    return value
