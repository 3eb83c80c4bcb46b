"""Markdown text of a viewer's panel; names may contain any character."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from beags_plugin.labels.colors import colorize
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.system.pasted import command, quoted

if TYPE_CHECKING:
    from viser import GuiApi

WORDS_APART = '{" "}'  # It stands between the words of a command.
_LONGEST = 40  # Characters of a name that fit into the panel's width.
_NERFSTUDIO = re.compile(r"(?P<before>.*)\n```\n(?P<command>ns-[^\n]*)\n```\s*", re.DOTALL)
_PATHS = ("--load-config", "--camera-path-filename", "--output-path", "--output-dir")


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


def pasteable(line: str) -> str:
    """Return a command to copy: one click selects all of it. No line breaks after the hyphen of an option."""
    style = '{{whiteSpace: "pre-wrap", overflowWrap: "anywhere", userSelect: "all", fontSize: "0.8em"}}'
    whole = '{{display: "inline-block", maxWidth: "100%"}}'
    words = [f"<span style={whole}>{_literal(word)}</span>" if word else "" for word in line.split(" ")]
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


class Listed:
    """The classes that a viewer lists: those that have Gaussians, under their present names.

    labels: unique label to class id, ascending. counts: class id to number of Gaussians.
    """

    def __init__(self) -> None:
        self.labels: dict[str, int] = {}
        self.counts: dict[int, int] = {}
        self._key: tuple | None = None

    def refresh(self, model: SceneModel) -> bool:
        """Update the list if the model's classes have changed; return whether they have."""
        ids = model.class_ids
        assigned, names = bool(model.assigned), tuple(model.classes.items())
        key = (assigned, ids.data_ptr(), len(ids), ids._version, id(model.objects), names)
        if key == self._key:
            return False
        members = model.members()
        self.counts = {c: int(members.of(c).sum()) for c in members.present()} if assigned else {}
        self.labels = unique_labels({class_id: model.classes.get(class_id, "") for class_id in self.counts})
        self._key = key
        return True


def show_to_paste(gui: GuiApi) -> None:
    """Let a page show nerfstudio's commands as ``to_paste`` writes them. gui: the page's own."""
    add_markdown = gui.add_markdown

    def show(content: str, *arguments: Any, **options: Any) -> Any:
        return add_markdown(to_paste(content), *arguments, **options)

    gui.add_markdown = show  # type: ignore[method-assign]


def to_paste(text: str) -> str:
    """Return Markdown that shows all of a nerfstudio command, with quoted paths; other texts stay as they are.

    For a camera path ``beags render``, which needs no ffmpeg, comes first.
    """
    if (match := _NERFSTUDIO.fullmatch(text)) is None:
        return text
    program, *options = re.split(r" (?=--)", match["command"].strip())
    values = {name: value for name, _, value in (option.partition(" ") for option in options)}
    theirs = " ".join([program, *(_option(*each) for each in values.items())])
    if program != "ns-render camera-path":
        return f"{match['before']}\n\n{pasteable(theirs)}"
    words = ["--load-config", values["--load-config"], "--camera-path", values["--camera-path-filename"]]
    ours = command(["beags", "render", *words])
    return f"{match['before']}\n\n{pasteable(ours)}\n\nor, where ffmpeg is installed,\n\n{pasteable(theirs)}"


def _option(name: str, value: str) -> str:
    return f"{name} {quoted(value) if name in _PATHS else value}".strip()
