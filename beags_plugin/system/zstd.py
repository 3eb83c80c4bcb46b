"""The zstd library, which is a part of Python only since 3.14."""

from __future__ import annotations

from typing import Any

from beags_plugin.system.errors import UserError


def zstandard() -> Any:
    """Return the module ``zstandard``; raises ``UserError`` where it is not installed."""
    try:
        import zstandard as library  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise UserError(f".spz version 4 needs the library zstandard ({error}): pip install zstandard.") from error
    return library
