"""Folders of TOML files that ship with the package, and a reader of such files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from beags_plugin.system.errors import UserError
from beags_plugin.system.reading.text import load_toml, reason

_PACKAGE = Path(__file__).resolve().parents[1]


def shipped_folder(name: str) -> Path:
    """Return the folder ``name``, such as method_configs, in the installed package, or beside it in a checkout."""
    installed = _PACKAGE / name
    return installed if installed.is_dir() else _PACKAGE.parent / name


def shipped_names(folder: str) -> list[str]:
    """Return the names of the TOML files of a shipped folder, without suffix, sorted."""
    return sorted(path.stem for path in shipped_folder(folder).glob("*.toml"))


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Read a TOML file; raises ``UserError`` if it cannot be read. what: the user's word for the file ("preset")."""
    try:
        return load_toml(path)
    except OSError as error:
        message = f"the {what} {path} cannot be read ({reason(error)}): name an existing file of that kind."
        raise UserError(message) from error
    except ValueError as error:
        raise UserError(f"the {what} {path} is no TOML ({reason(error)}): correct the file.") from error
