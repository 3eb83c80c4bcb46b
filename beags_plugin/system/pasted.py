"""Commands in messages, quoted so that they can be pasted into a shell."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from pathlib import Path


def quoted(word: str | Path) -> str:
    """Return a word of a command, in quotes if it holds spaces, brackets or others that a shell interprets."""
    return shlex.quote(str(word))


def command(words: Iterable[str | Path]) -> str:
    """Return a command line of these words."""
    return shlex.join(map(str, words))
