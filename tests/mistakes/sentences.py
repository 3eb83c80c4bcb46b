"""What is said of each mistake, kept in a file beside this one: a line with its name, one with the sentence."""

from __future__ import annotations

from pathlib import Path

_FILE = Path(__file__).with_name("sentences.txt")
_INDENT = "    "


def _read() -> dict[str, str]:
    found: dict[str, str] = {}
    name = ""
    for line in _FILE.read_text("utf8").splitlines() if _FILE.exists() else ():
        if line.startswith(_INDENT):
            found[name] = line.removeprefix(_INDENT)
        else:
            name = line
    return found


SENTENCES = _read()


def write_sentence(name: str, sentence: str) -> None:
    """Keep what is said of a mistake; those that are in the table no more go."""
    from mistakes.table import TABLE

    found = {**_read(), name: sentence}
    _FILE.write_text("".join(f"{title}\n{_INDENT}{found[title]}\n" for title in TABLE if title in found), "utf8")
