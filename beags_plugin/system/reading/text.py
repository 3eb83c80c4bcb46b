"""JSON and TOML, with every failure as a ``ValueError``."""

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


def load_json(path: Path, object_pairs_hook: Callable[[list], Any] | None = None) -> Any:
    """Read a JSON file; raises ``OSError`` if it cannot be read, ``ValueError`` if it is no JSON."""
    try:
        return json.loads(path.read_bytes().decode("utf-8"), object_pairs_hook=object_pairs_hook)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raises as ``load_json``."""
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8"))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def reason(error: Exception) -> str:
    """Describe the error in a few words on one line, for the brackets of a sentence."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is no UTF-8"
    if isinstance(error, KeyError):
        return f"{error} is missing"
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:197]}..."
