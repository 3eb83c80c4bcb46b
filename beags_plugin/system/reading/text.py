"""Text, JSON and TOML, whose depth and length are bounded."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]  (installed on Python 3.10 only)

MB = 10**6
MOST_BYTES = 16 * MB
"""Of files that list names, options or one transform. What Python makes of it takes up to 33 times as much memory (of
short tables; of numbers 7 to 13 times), so a hostile file can take half a gigabyte."""
MOST_BYTES_OF_POSES = 64 * MB
"""Of transforms.json: a hundred thousand views."""
MOST_BYTES_OF_MASKS = 128 * MB
"""Of run lengths and polygons of the masks of all views."""
MOST_BYTES_OF_TOML = 1 * MB
"""Its parser takes seconds for each."""
_TOO_DEEP = "it is nested too deeply"


def load_json(path: Path, object_pairs_hook: Callable[[list], Any] | None = None, most_bytes: int = MOST_BYTES) -> Any:
    """The content of a JSON file of at most ``most_bytes``.

    Raises ``OSError`` if it cannot be read, ``ValueError`` with the reason if it is longer or no JSON.
    """
    try:
        return json.loads(load_text(path, most_bytes), object_pairs_hook=object_pairs_hook)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def load_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; raises as ``load_json``."""
    try:
        return tomllib.loads(load_text(path, MOST_BYTES_OF_TOML))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def load_text(path: Path, most_bytes: int = MOST_BYTES) -> str:
    """The content of a text file; raises as ``load_json``."""
    with open(path, "rb") as file:
        content = file.read(most_bytes + 1)  # not by the size that the system tells: a pipe has none
    if len(content) > most_bytes:
        raise ValueError(f"it is longer than the {most_bytes // MB} MB that such a file may have")
    return content.decode("utf-8")


def reason(error: Exception) -> str:
    """What was wrong, in a few words on one line, for the brackets of a sentence."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is no UTF-8"
    if isinstance(error, KeyError):
        return f"{error} is missing"
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:197]}..."
