"""The command line of the running program, for what nerfstudio's programs do not pass on to plugins."""

from __future__ import annotations

import sys
from pathlib import Path


def program_name() -> str:
    """Return the name of this program without folder and suffix, such as ns-train."""
    return Path(sys.argv[0]).stem


def path_option(name: str) -> Path | None:
    """Return the path that this program's command line gives an option, spelt with - or _; None without the option."""
    words = sys.argv[1:]
    for index, word in enumerate(words):
        option, equals, value = word.partition("=")
        if option.replace("_", "-") == name and (equals or index + 1 < len(words)):
            return Path(value if equals else words[index + 1])
    return None
