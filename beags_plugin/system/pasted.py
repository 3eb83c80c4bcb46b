"""Commands in messages, quoted so that a shell takes them as they are printed."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path


def quoted(word: str | Path) -> str:
    """Return a word of a command, in quotes where it holds spaces, brackets or else what a shell takes for its own."""
    return shlex.quote(str(word))


def command(words: Iterable[str | Path]) -> str:
    """Return a command line of these words."""
    return shlex.join(map(str, words))
