"""Set up the page of a finished run: no controls of training, and pictures at rest as large as the canvas.

Viser's camera messages do not contain the size of the canvas, so a script in the page sends it. Viser ignores what a
page sends before its first camera, and a text that another page has sent already; so the script comes with the first
camera, and its text begins with the page's number.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from viser import _messages

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer
    from viser import ClientHandle, GuiEvent, ViserServer

_LABEL = "Canvas of this page"
_FIRST = 512  # Pixels of the longer side until the page has sent its own; nerfstudio's default.
_LARGEST = 2048  # Largest value of nerfstudio's slider Max res.
_TELL = """
(() => {
  clearInterval(window.beagsTells);
  let told = "";
  window.beagsTells = setInterval(() => {
    const label = [...document.querySelectorAll("label")].find((each) => each.innerText.trim() == LABEL);
    const canvas = document.querySelector("canvas[data-engine]");
    let row = label;
    while (row && !row.querySelector("input")) row = row.parentElement;
    if (!row || !canvas) return;
    const input = row.querySelector("input");
    if (row.parentElement) row.parentElement.style.display = "none";
    const size = PAGE + " " + canvas.clientWidth + "x" + canvas.clientHeight;
    if (size == told) return;
    told = size;
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, size);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  }, 300);
})();
"""
"""Script in the page that writes each change of the canvas's size into a hidden text field."""


class Windows:
    """The canvas sizes of all pages of a viewer."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._sizes: dict[int, tuple[int, int]] = {}
        server: ViserServer = viewer.viser_server
        field = server.gui.add_text(_LABEL, "")
        field.on_update(self._resized)
        server.on_client_connect(self._joined)
        server.on_client_disconnect(self._left)
        viewer.control_panel._max_res.value = _LARGEST  # It now only bounds the canvas's size.

    @staticmethod
    def _joined(client: ClientHandle) -> None:
        script = _TELL.replace("LABEL", json.dumps(_LABEL)).replace("PAGE", str(client.client_id))
        client.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(script))

    def _left(self, client: ClientHandle) -> None:
        self._sizes.pop(client.client_id, None)

    def _resized(self, event: GuiEvent) -> None:
        try:
            width, height = (int(word) for word in str(event.target.value).partition(" ")[2].split("x"))
        except ValueError:
            return
        if event.client_id is not None and min(width, height) > 0:
            self._sizes[event.client_id] = width, height
            self._viewer._trigger_rerender()

    def size(self, client_id: int, aspect: float) -> tuple[int, int]:
        """Return (height, width) of a page's picture at rest, bounded by the slider Max res.

        aspect: width over height.
        """
        width, height = self._sizes.get(client_id, (0, 0))
        longest = max(width, height) or _FIRST
        longest = min(longest, self._viewer.control_panel.max_res)
        height = round(longest / max(1.0, aspect))
        return max(height, 1), max(round(height * aspect), 1)


def set_up_finished(viewer: Viewer) -> Windows:
    """Hide nerfstudio's controls of training and a logo that it loads from the web; return the pages' sizes."""
    viewer.pause_train.visible = viewer.resume_train.visible = False
    for control in (viewer.control_panel._train_speed, viewer.control_panel._train_util):
        control.set_hidden(True)
    # Nerfstudio leaves the step of a finished run at 0, so only the size is shown.
    viewer.make_stats_markdown = lambda step, size: f"Resolution: {size}"  # type: ignore[method-assign]
    viewer.stats_markdown.content = ""
    viewer.viser_server.gui.configure_theme(
        titlebar_content=None, control_layout="collapsible", dark_mode=True, brand_color=(255, 211, 105)
    )
    return Windows(viewer)
