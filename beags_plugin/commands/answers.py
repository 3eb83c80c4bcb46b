"""The console of all commands, and JSON files of what they print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rich.console import Console

from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False, markup=False)  # Paths may hold brackets.


def write_json(path: Path | None, content: object) -> None:
    """Write ``content`` as JSON, paths as text, unless ``path`` is None; raises ``UserError`` if that fails."""
    if path is not None:
        write_text_atomically(json.dumps(content, indent=2, default=str) + "\n", path)


def read_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; empty if the file cannot be read or holds something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}
