"""The sentence that beags prints for each mistake, kept in a file beside this one.

A line has the mistake's name, the next the sentence.
"""

from __future__ import annotations

from pathlib import Path

_FILE = Path(__file__).with_name("sentences.txt")


def read_sentences() -> dict[str, str]:
    """Return the kept sentence of every mistake."""
    lines = _FILE.read_text("utf8").splitlines() if _FILE.exists() else []
    return {name: sentence.strip() for name, sentence in zip(lines[::2], lines[1::2], strict=True)}


def write_sentence(name: str, sentence: str, names: list[str]) -> None:
    """Keep the sentence of a mistake, in the order of ``names``; sentences of other mistakes go."""
    sentences = {**read_sentences(), name: sentence}
    lines = [line for title in names if title in sentences for line in (title, f"    {sentences[title]}")]
    _FILE.write_text("\n".join(lines) + "\n", "utf8")
