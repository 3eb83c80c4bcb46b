"""What commands print, and the files that say the same."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console

from beags_plugin.system.whole_files import write_text_atomically

CONSOLE = Console(soft_wrap=True, highlight=False)


def counted_gaussians(count: int, left_out: object) -> str:
    """Return a phrase on an object's Gaussians. left_out: those dropped, or None if nothing was looked for."""
    return f"{count} Gaussians" if left_out is None else f"{count} Gaussians; {left_out}"


def write_json(path: Path | None, content: object) -> None:
    """Write ``content`` as JSON, paths as text, unless ``path`` is None; raises ``UserError`` if that fails."""
    if path is not None:
        write_text_atomically(json.dumps(content, indent=2, default=str) + "\n", path)
