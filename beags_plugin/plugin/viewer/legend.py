"""Markdown text of a viewer's panel; names may contain any character."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from beags_plugin.labels.colors import colorize

WORDS_APART = '{" "}'  # It stands between the words of a command.
_LONGEST = 40  # Characters of a name that fit into the panel's width.


@dataclass(frozen=True)
class LegendRow:
    """A class of the legend. count: number of its Gaussians. state: any but "shown" is struck out."""

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
    """Return a text whose long words, such as paths, are broken at the panel's width."""
    return f'<div style={{{{overflowWrap: "anywhere"}}}}>{_literal(text)}</div>'


def pasteable(command: str) -> str:
    """Return a command to copy: one click selects all of it. No line breaks after the hyphen of an option."""
    style = '{{whiteSpace: "pre-wrap", overflowWrap: "anywhere", userSelect: "all", fontSize: "0.8em"}}'
    whole = '{{display: "inline-block", maxWidth: "100%"}}'
    words = [f"<span style={whole}>{_literal(word)}</span>" if word else "" for word in command.split(" ")]
    return f"<pre style={style}>{WORDS_APART.join(words)}</pre>"


def _literal(text: str) -> str:
    """Return text as a JavaScript string of MDX, so that neither Markdown nor viser interprets any of it."""
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
    """Return text for Markdown with special characters escaped; viser reads MDX, which runs what braces enclose."""
    plain = set(" .,:;%…")
    return "".join(c if c.isalnum() or c in plain else f"&#{ord(c)};" for c in text)


def unique_labels(classes: Mapping[int, str]) -> dict[str, int]:
    """Return unique labels of the classes for a drop-down, label to id, in the order of ids.

    A label is the name, with the id if the name is empty or repeated: browsers reject equal and empty entries.
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
