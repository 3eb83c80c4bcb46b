"""An extension of griffe that makes lists of attributes and parameters that a docstring describes as ``name: ...``."""

from __future__ import annotations

import re
from typing import Any

import griffe


class DocstringLists(griffe.Extension):
    """Makes a list item of each description in a docstring; only the object's own names begin one."""

    def on_class(self, *, cls: griffe.Class, **kwargs: Any) -> None:
        self._list(cls, set(cls.members))

    def on_function(self, *, func: griffe.Function, **kwargs: Any) -> None:
        self._list(func, {parameter.name for parameter in func.parameters})

    @staticmethod
    def _list(thing: griffe.Class | griffe.Function, names: set[str]) -> None:
        if thing.docstring is not None and names:
            thing.docstring.value = listed(thing.docstring.value, names)


def listed(text: str, names: set[str]) -> str:
    """Return the text with an item "- **name**: ..." for each description of one or several of ``names``."""
    first, _, rest = text.partition("\n")
    name = "(?:" + "|".join(map(re.escape, sorted(names))) + r")\b(?: \[[^\]]*\](?: \w+)?)?"
    start = re.compile(rf"(?:^|(?<=[.;] )) *({name}(?:, {name})*): ", re.MULTILINE)
    paragraphs = []
    for paragraph in rest.strip("\n").split("\n\n"):
        before, *pieces = start.split(paragraph)
        items = [
            f"- **{words}**: " + " ".join(body.split()) for words, body in zip(pieces[::2], pieces[1::2], strict=True)
        ]
        paragraphs.append("\n\n".join(part for part in (before.strip("\n"), "\n".join(items)) if part))
    return "\n\n".join(part for part in (first, *paragraphs) if part)
