"""Clicks on a viewer's picture, but not the drags that turn the camera."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from viser import GuiInputHandle, SceneNodePointerEvent, ViserServer

_AROUND = "/beags_clicks"  # Name of the box.
_FAR = 1e4  # Half the side of the box in viser's units, beyond what a page draws.
_INSIDES = [
    (0, 3, 1), (0, 2, 3), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 7, 3), (2, 6, 7), (0, 6, 2), (0, 4, 6), (1, 3, 7), (1, 7, 5),
]  # fmt: skip
"""Triangles of a cube whose corners are in binary order, facing inwards, so that hovering draws no outline."""


class SceneClicks:
    """Receives clicks on the picture while one of its checkboxes is ticked, by an invisible box around the scene."""

    def __init__(self, server: ViserServer) -> None:
        self._server = server
        self._around: Any = None
        self._ticked: Any = None
        self._changing = threading.Lock()  # Each control calls its listener in a thread of its own.

    def offer(self, checkbox: GuiInputHandle[bool], listener: Callable[[SceneNodePointerEvent], None]) -> None:
        """Send clicks to ``listener`` while ``checkbox`` is ticked; ticking it unticks the others."""
        checkbox.on_update(lambda _: self._follow(checkbox, listener))

    def _follow(self, checkbox: GuiInputHandle[bool], listener: Callable[[SceneNodePointerEvent], None]) -> None:
        with self._changing:
            if checkbox.value == (self._ticked is checkbox):
                return
            former, self._ticked = self._ticked, checkbox if checkbox.value else None
            if self._around is not None:
                self._around.remove()
                self._around = None
            if self._ticked is None:
                return
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
            faces = np.array(_INSIDES, np.uint32)
            self._around = self._server.scene.add_mesh_simple(_AROUND, _FAR * corners, faces, opacity=0.0)
            self._around.on_click(listener)
            if former is not None:
                former.value = False
