"""JSON and TOML: text whose depth and length are bounded."""

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

MOST_BYTES = 1 << 30
"""Longer files are refused: parsed, they would take many times as much memory."""
_TOO_DEEP = "it is nested too deeply"


def load_json(path: Path, object_pairs_hook: Callable[[list], Any] | None = None) -> Any:
    """The content of a JSON file; ``OSError`` if it cannot be read, ``ValueError`` with the reason if it is no JSON."""
    try:
        return json.loads(_text(path), object_pairs_hook=object_pairs_hook)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def load_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; raises as ``load_json``."""
    try:
        return tomllib.loads(_text(path))
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None


def _text(path: Path) -> str:
    if (size := path.stat().st_size) > MOST_BYTES:
        raise ValueError(f"it is {size} bytes long, and at most {MOST_BYTES} are read")
    return path.read_text(encoding="utf-8")


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
