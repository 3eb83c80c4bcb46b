"""Readers of JSON, TOML and plain text that turn every failure of content into a ``ValueError``."""

from __future__ import annotations

import codecs
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from beags_plugin.system.reading.stand_ins import stand_in

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]  (installed on Python 3.10 only)

_WIDE = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)  # editors and PowerShell on Windows write them
# Other programs write these into JSON: comments, a comma after the last entry, and C's spellings of nan and infinity.
_LOOSE = re.compile(
    r'(?P<text>"(?:[^"\\]|\\.)*")'
    r"|(?P<comment>//[^\n]*|/\*.*?\*/|^[ \t]*\#[^\n]*)"
    r"|(?P<comma>,(?=(?:\s|//[^\n]*\n|/\*.*?\*/|\#[^\n]*\n)*[\]}]))"
    r"|(?P<nan>[-+]?\b(?:[nN][aA][nN](?:\([\w.]*\))?|1\.\#(?:QNAN|SNAN|IND)\w*)(?![\w\"]))"
    r"|(?P<sign>[-+]?)(?P<endless>\b(?:[iI][nN][fF](?:[iI][nN][iI][tT][yY])?|1\.\#INF\w*)(?![\w\"]))",
    re.DOTALL | re.MULTILINE,
)


def read_text(path: Path) -> str:
    """Read a text file: UTF-8 with or without a byte order mark, or UTF-16 with one.

    Raises ``OSError`` if it cannot be read, ``ValueError`` if it is no such text.
    """
    content = path.read_bytes()
    return content.decode("utf-16" if content.startswith(_WIDE) else "utf-8-sig")


def load_json(path: Path, object_pairs_hook: Callable[[list], Any] | None = None) -> Any:
    """Read a JSON file; raises ``OSError`` if it cannot be read, ``ValueError`` if it is no JSON.

    Comments, a comma after the last entry, and any spelling of NaN and Infinity are read too.
    """
    text = read_text(path)

    def parsed(given: str) -> Any:
        return json.loads(given, object_pairs_hook=object_pairs_hook, strict=False)  # accepts tabs within strings

    try:
        return parsed(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    except ValueError:
        if (cause := stand_in(path)) is not None:
            raise ValueError(cause) from None
        if (strict := _LOOSE.sub(_strict, text)) == text:
            raise
        try:
            return parsed(strict)
        except ValueError:
            pass
        raise


def _strict(part: re.Match[str]) -> str:
    """Return strict JSON for a match of ``_LOOSE``; line ends stay, so that errors name the right line."""
    if part["text"] is not None:
        return part["text"]
    if part["nan"] is not None:
        return "NaN"
    if part["endless"] is not None:
        return ("-" if part["sign"] == "-" else "") + "Infinity"
    return "\n" * part[0].count("\n")


def number_of(word: str) -> float:
    """Return the number that a word of a file spells, also C's nan and infinity; raises ``ValueError`` for others."""
    try:
        return float(word)
    except ValueError:
        match = _LOOSE.fullmatch(word)
        if match is None or not (match["nan"] or match["endless"]):
            raise
        return float(_strict(match).lower())


def load_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; raises as ``load_json``."""
    try:
        return tomllib.loads(read_text(path))
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def reason(error: Exception) -> str:
    """Describe the error in a few words on one line, for the brackets of a sentence."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is no {'UTF-16' if error.encoding.startswith('utf-16') else 'UTF-8'}"
    if isinstance(error, KeyError):
        return f"{error} is missing"
    words = " ".join(str(error).split()) or type(error).__name__
    return words if len(words) <= 200 else f"{words[:197]}..."
