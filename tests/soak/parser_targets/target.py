"""A parser as a function of bytes, and what all of them need."""

from __future__ import annotations

import io
import json
import tempfile
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from beags_plugin.system.errors import UserError

SIDE = 6  # pixels of the pictures
FOLDER = Path("/dev/shm") if Path("/dev/shm").is_dir() else Path(tempfile.gettempdir())


@dataclass(frozen=True)
class Target:
    """One parser. read: is given the file. seeds: valid files. wrap: makes a file of the bytes that are changed."""

    file: str
    read: Callable[[Path], Any]
    seeds: Callable[[], list[bytes]]
    wrap: Callable[[bytes], bytes] = lambda content: content


_FOLDERS: list[tempfile.TemporaryDirectory[str]] = []


@lru_cache(None)
def folder() -> Path:
    """Return the folder of this process's files."""
    made = tempfile.TemporaryDirectory(prefix="beags-fuzz-", dir=FOLDER)  # removed when the process ends
    _FOLDERS.append(made)
    return Path(made.name)


def examine(target: Target, content: bytes) -> str | None:
    """Return None if the parser takes a file, else its sentence; anything else raises."""
    path = folder() / target.file
    path.write_bytes(target.wrap(content))
    try:
        with redirect_stdout(io.StringIO()):
            target.read(path)
    except UserError as error:
        sentence = str(error)
        if "\n" in sentence or len(sentence) > 2000:
            raise AssertionError(f"not one sentence: {sentence[:300]!r}") from error
        return sentence
    return None


@lru_cache(None)
def pictures() -> Path:
    """Return a folder of three pictures."""
    images = folder() / "images"
    images.mkdir()
    for name in "abc":
        Image.fromarray(np.zeros((SIDE, SIDE, 3), np.uint8)).save(images / f"{name}.png")
    return images


def as_json(content: Any) -> bytes:
    return json.dumps(content).encode()
