"""The folders of TOML files that ship with the package, and reading such a file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from beags_plugin.errors import UserError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]  (installed on Python 3.10 only)

_PACKAGE = Path(__file__).resolve().parent


def shipped_folder(name: str) -> Path:
    """Where ``name`` (method_configs, experiments) lies: in the installed package, or beside it in a checkout."""
    installed = _PACKAGE / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """The content of a TOML file; raises ``UserError`` if it cannot be read. what: for the sentence, e.g. "preset"."""
    try:
        return tomllib.loads(path.read_text("utf8"))
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"the {what} {path} cannot be read ({reason}): name an existing file of that kind.") from error
