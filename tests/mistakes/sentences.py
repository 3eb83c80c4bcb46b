"""What is said of each mistake, kept in a file beside this one.

A line has the mistake's name, the next the sentence. A line "was: ..." between them says what the first run of the
table found instead, where something had to be mended.
"""

from __future__ import annotations

from pathlib import Path

_FILE = Path(__file__).with_name("sentences.txt")
_INDENT, _WAS = "    ", "    was: "

SENTENCES: dict[str, str] = {}
WAS: dict[str, str] = {}


def _read() -> None:
    name = ""
    for line in _FILE.read_text("utf8").splitlines() if _FILE.exists() else ():
        if line.startswith(_WAS):
            WAS[name] = line.removeprefix(_WAS)
        elif line.startswith(_INDENT):
            SENTENCES[name] = line.removeprefix(_INDENT)
        else:
            name = line


_read()


def write_sentence(name: str, sentence: str) -> None:
    """Keep what is said of a mistake; those that are in the table no more go."""
    from mistakes.table import TABLE

    SENTENCES[name] = sentence
    lines = []
    for title in TABLE:
        if title in SENTENCES:
            lines += [title, *([_WAS + WAS[title]] if title in WAS else []), _INDENT + SENTENCES[title]]
    _FILE.write_text("\n".join(lines) + "\n", "utf8")
