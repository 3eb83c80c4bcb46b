"""Markdown text of a viewer's panel; names may hold anything."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from beags_plugin.labels.colors import colorize

WORDS_APART = '{" "}'  # between the words of a command
_LONGEST = 40  # characters of a name that the panel's width has room for


@dataclass(frozen=True)
class LegendRow:
    """A class of the legend. count: of its Gaussians. state: any but "shown" is struck out."""

    class_id: int
    name: str
    count: int
    state: str = "shown"


def legend(rows: Iterable[LegendRow]) -> str:
    """Return a table of classes in their colours (see ``labels.colors.colorize``)."""
    lines = ["| | object | Gaussians |", "|---|---|---:|"]
    for row in rows:
        name = escaped(shortened(row.name))
        text = {"shown": name, "hidden": f"~~{name}~~"}.get(row.state, f"~~{name}~~ {row.state}")
        lines.append(f"| {swatch(row.class_id)} | {text} | {row.count:,} |")
    return "\n".join(lines)


def swatch(class_id: int) -> str:
    """Return a small square in the colour of a class."""
    style = f'{{{{display: "block", width: "1em", height: "1em", background: "{hex_color(class_id)}"}}}}'
    return f"<span style={style} />"


def wrapped(text: str) -> str:
    """Return a text of which no word, such as a path, is wider than the panel."""
    return f'<div style={{{{overflowWrap: "anywhere"}}}}>{_literal(text)}</div>'


def pasteable(command: str) -> str:
    """Return a command to copy: one click chooses all of it. No line ends after the hyphen of an option."""
    style = '{{whiteSpace: "pre-wrap", overflowWrap: "anywhere", userSelect: "all", fontSize: "0.8em"}}'
    whole = '{{display: "inline-block", maxWidth: "100%"}}'
    words = [f"<span style={whole}>{_literal(word)}</span>" if word else "" for word in command.split(" ")]
    return f"<pre style={style}>{WORDS_APART.join(words)}</pre>"


def _literal(text: str) -> str:
    """Return text as a JavaScript string of MDX; no part of it is taken for Markdown, or for a picture by viser."""
    return f"{{{json.dumps(text)}}}".replace("!", "\\u0021").replace("<", "\\u003c")


def hex_color(class_id: int) -> str:
    """Return the colour of a class, as #rrggbb."""
    red, green, blue = colorize(np.array([[class_id]]))[0, 0]
    return f"#{red:02x}{green:02x}{blue:02x}"


def shortened(name: str) -> str:
    """Return a name on one line, cut if it is long."""
    line = " ".join(name.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"


def capitalised(message: object) -> str:
    """Return a message, such as that of an error, as a sentence that stands alone."""
    text = str(message)
    return f"{text[:1].upper()}{text[1:]}"


def escaped(text: str) -> str:
    """Return text for Markdown, which viser reads as MDX: braces and angle brackets would be taken for a program."""
    plain = set(" .,:;%…")
    return "".join(c if c.isalnum() or c in plain else f"&#{ord(c)};" for c in text)


def unique_labels(classes: Mapping[int, str]) -> dict[str, int]:
    """Return a drop-down's entries for the classes, to their ids, in the order of ids: names, if need be with the id.

    Browsers refuse a list with two equal entries, or an empty one.
    """
    names = [shortened(name) for name in classes.values()]
    labels: dict[str, int] = {}
    for class_id, name in sorted(classes.items()):
        label = shortened(name)
        if not label or names.count(label) > 1:
            label = f"{label} ({class_id})".strip()
        while label in labels:
            label += "'"
        labels[label] = class_id
    return labels
