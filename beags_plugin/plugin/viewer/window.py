"""A page of a finished run: nothing of a training, and a picture at rest that is as large as the canvas it fills.

viser's camera messages do not tell the size of the canvas, so a script of the page does.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from viser import _messages

if TYPE_CHECKING:
    from nerfstudio.viewer.viewer import Viewer
    from viser import GuiEvent, ViserServer

_LABEL = "Canvas of this page"
_FIRST = 512  # pixels of the longer side, until the page has told its own; nerfstudio's default
_LARGEST = 2048  # of nerfstudio's slider Max res
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
    const size = canvas.clientWidth + "x" + canvas.clientHeight;
    if (size == told) return;
    told = size;
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(input, size);
    input.dispatchEvent(new Event("input", { bubbles: true }));
  }, 300);
})();
"""
"""A script of the page: it writes the canvas's size into a text field that it hides, whenever that changes."""


class Windows:
    """The sizes of the canvases of all pages of a viewer; ``changed`` is called after one has become known."""

    def __init__(self, viewer: Viewer) -> None:
        self._viewer = viewer
        self._sizes: dict[int, tuple[int, int]] = {}
        server: ViserServer = viewer.viser_server
        field = server.gui.add_text(_LABEL, "")
        field.on_update(self._told)
        script = _TELL.replace("LABEL", json.dumps(_LABEL))
        server.gui._websock_interface.queue_message(_messages.RunJavascriptMessage(script))
        viewer.control_panel._max_res.value = _LARGEST  # it bounds the canvas's size from now on

    def _told(self, event: GuiEvent) -> None:
        try:
            width, height = (int(word) for word in str(event.target.value).split("x"))
        except ValueError:
            return
        if event.client_id is not None and min(width, height) > 0:
            self._sizes[event.client_id] = width, height
            self._viewer._trigger_rerender()

    def size(self, client_id: int, aspect: float) -> tuple[int, int]:
        """Return (height, width) of a page's picture at rest, at most as large as the slider Max res says.

        aspect: width over height.
        """
        width, height = self._sizes.get(client_id, (0, 0))
        longest = max(width, height) or _FIRST
        longest = min(longest, self._viewer.control_panel.max_res)
        height = round(longest / max(1.0, aspect))
        return max(height, 1), max(round(height * aspect), 1)


def shown_finished(viewer: Viewer) -> Windows:
    """Leave out what nerfstudio shows of a training, and a logo that it loads from the web; return the pages' sizes."""
    viewer.pause_train.visible = viewer.resume_train.visible = False
    for control in (viewer.control_panel._train_speed, viewer.control_panel._train_util):
        control.set_hidden(True)
    # nerfstudio leaves the step of a finished run at 0, so the size is shown alone
    viewer.make_stats_markdown = lambda step, size: f"Resolution: {size}"  # type: ignore[method-assign]
    viewer.stats_markdown.content = ""
    viewer.viser_server.gui.configure_theme(
        titlebar_content=None, control_layout="collapsible", dark_mode=True, brand_color=(255, 211, 105)
    )
    return Windows(viewer)
