"""Quote and wrap the commands in nerfstudio's tabs Render and Export, so that they work in a terminal."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from beags_plugin.plugin.viewer.legend import pasteable
from beags_plugin.system.pasted import command, quoted

if TYPE_CHECKING:
    from viser import GuiApi

_SHOWN = re.compile(r"(?P<before>.*)\n```\n(?P<command>ns-[^\n]*)\n```\s*", re.DOTALL)
_PATHS = ("--load-config", "--camera-path-filename", "--output-path", "--output-dir")


def show_to_paste(gui: GuiApi) -> None:
    """Let a page show nerfstudio's commands as ``to_paste`` writes them. gui: the page's own."""
    shown = gui.add_markdown

    def show(content: str, *arguments: Any, **options: Any) -> Any:
        return shown(to_paste(content), *arguments, **options)

    gui.add_markdown = show  # type: ignore[method-assign]


def to_paste(text: str) -> str:
    """Return Markdown that shows all of a nerfstudio command, with quoted paths; other texts stay as they are.

    For a camera path ``beags render``, which needs no ffmpeg, comes first.
    """
    if (match := _SHOWN.fullmatch(text)) is None:
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
