"""Commands that nerfstudio's own tabs show are taken by a shell as they stand, and none is wider than its window."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("nerfstudio")

from nerfstudio.viewer.export_panel import show_command_modal
from run_folders import write_scene, write_trained
from viewer_windows import Window

from beags_plugin.objects.render import read_camera_path
from beags_plugin.plugin.viewer.legend import show_to_paste, to_paste


class Page:
    """A page's controls as nerfstudio's windows use them; ``texts`` holds what they show."""

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.add_markdown = self.texts.append
        show_to_paste(self)  # type: ignore[arg-type]

    def add_modal(self, title: str):
        return nullcontext()

    def add_button(self, label: str):
        return SimpleNamespace(on_click=lambda function: function)

    def commands(self) -> list[list[str]]:
        """Return the words of every command that is shown."""
        blocks = re.findall(r"<pre style=\{\{([^}]*)\}\}>(.*?)</pre>", self.texts[-1])
        assert all('whiteSpace: "pre-wrap"' in style for style, _ in blocks)
        words = [re.findall(r"\{(\"[^\"]*\")\}</span>", text) for _, text in blocks]
        return [shlex.split(" ".join(map(json.loads, each))) for each in words]


def press(window: Window, label: str, client: object) -> None:
    """Press the button of nerfstudio's tab Render that is called so."""
    handles = window.viewer.viser_server.gui._gui_input_handle_from_id.values()
    button = next(handle for handle in handles if getattr(handle._impl, "label", "") == label)
    for heard in button._impl.update_cb:
        heard(SimpleNamespace(client=client, client_id=0, target=button))


def test_a_camera_path_is_rendered_by_what_the_window_shows(tmp_path, monkeypatch):
    """The tab Render, pressed in nerfstudio's own viewer, with folder and path whose names hold spaces."""
    config = write_trained(tmp_path / "my run", write_scene(tmp_path / "lab"))
    window, page = Window(config), Page()
    camera = SimpleNamespace(wxyz=np.array([1.0, 0, 0, 0]), position=np.zeros(3), aspect=1.5, fov=0.8)
    client = SimpleNamespace(gui=page, camera=camera, client_id=0)
    monkeypatch.setattr(window.viewer.viser_server, "get_clients", lambda: {0: client})
    try:
        press(window, "Add Keyframe", client)
        camera.position = np.ones(3)
        press(window, "Add Keyframe", client)
        handles = window.viewer.viser_server.gui._gui_input_handle_from_id.values()
        next(handle for handle in handles if handle._impl.label == "Render name")._impl.value = "a flight"
        press(window, "Generate Command", client)
    finally:
        window.close()
    ours, theirs = page.commands()
    (path,) = tmp_path.glob("*/camera_paths/*.json")
    assert ours == ["beags", "render", "--load-config", str(config), "--camera-path", str(path)]
    assert theirs[:4] == ["ns-render", "camera-path", "--load-config", str(config)]
    assert theirs[4:6] == ["--camera-path-filename", str(path)] and theirs[7].endswith("a flight.mp4")
    assert len(read_camera_path(path)[0]) > 1


def test_commands_of_the_tab_export_are_whole_too():
    page = Page()
    box = "--obb_center 0.1 -0.2 0.3 --obb_scale 1 2 3"
    told = f"ns-export gaussian-splat --load-config /a b/config.yml --output-dir exports/my splat/ {box}"
    show_command_modal(SimpleNamespace(gui=page), "splat", told)  # type: ignore[arg-type]
    (words,) = page.commands()
    assert words[:4] == ["ns-export", "gaussian-splat", "--load-config", "/a b/config.yml"]
    assert words[4:] == ["--output-dir", "exports/my splat/", *box.split()]


def test_other_texts_are_left_alone():
    for text in ("", "**A window** with `code`", "Before\n\n```\nls -l\n```"):
        assert to_paste(text) == text
