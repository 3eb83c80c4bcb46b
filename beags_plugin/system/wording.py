"""Words of sentences for users that depend on a number."""

from __future__ import annotations


def amount(count: int, noun: str, plural_verb: str = "") -> str:
    """Return a number with its noun, and the verb if there is one: "1 mask is", "3 masks are"."""
    said = f"{count} {noun}" if count == 1 else f"{count} {noun}s"
    return f"{said} {verb(count, plural_verb)}" if plural_verb else said


def verb(count: int, plural: str) -> str:
    """Return a verb for ``count`` subjects: "says" for "say", and "is" for "are", if there is one."""
    if count != 1:
        return plural
    return {"are": "is", "have": "has", "do": "does"}.get(plural, f"{plural}s")
