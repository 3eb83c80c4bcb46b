"""Commands that nerfstudio's tabs Render and Export show, quoted and wrapped so that a terminal takes them."""

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
    """Let a page show nerfstudio's commands as ``to_paste`` writes them. gui: the page's own, which has little else."""
    shown = gui.add_markdown

    def show(content: str, *arguments: Any, **options: Any) -> Any:
        return shown(to_paste(content), *arguments, **options)

    gui.add_markdown = show  # type: ignore[method-assign]


def to_paste(text: str) -> str:
    """Return a text with a command of nerfstudio's as Markdown that shows all of it, with quoted paths.

    A camera path is rendered by ``beags render`` too, which comes first: it needs no ffmpeg. Other texts stay as they
    are.
    """
    if (found := _SHOWN.fullmatch(text)) is None:
        return text
    program, *options = re.split(r" (?=--)", found["command"].strip())
    values = {name: value for name, _, value in (option.partition(" ") for option in options)}
    theirs = " ".join([program, *(_option(*each) for each in values.items())])
    if program != "ns-render camera-path":
        return f"{found['before']}\n\n{pasteable(theirs)}"
    words = ["--load-config", values["--load-config"], "--camera-path", values["--camera-path-filename"]]
    ours = command(["beags", "render", *words])
    return f"{found['before']}\n\n{pasteable(ours)}\n\nor, where ffmpeg is installed,\n\n{pasteable(theirs)}"


def _option(name: str, value: str) -> str:
    return f"{name} {quoted(value) if name in _PATHS else value}".strip()
