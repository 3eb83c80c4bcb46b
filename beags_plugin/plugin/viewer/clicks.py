"""Clicks on a viewer's picture, of which a drag that turns the camera is none."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from viser import GuiInputHandle, SceneNodePointerEvent, ViserServer

_AROUND = "/beags_clicks"  # name of the box
_FAR = 1e4  # viser's units: half of its side, beyond what a page draws
_INSIDES = [
    (0, 3, 1), (0, 2, 3), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
    (2, 7, 3), (2, 6, 7), (0, 6, 2), (0, 4, 6), (1, 3, 7), (1, 7, 5),
]  # fmt: skip
"""Triangles of a cube whose corners are in binary order, seen from inside: an outline for the mouse shows nothing."""


class SceneClicks:
    """Takes clicks on the picture while one of its checkboxes is ticked, by a box around the scene that nobody sees."""

    def __init__(self, server: ViserServer) -> None:
        self._server = server
        self._around: Any = None
        self._ticked: Any = None
        self._changing = threading.Lock()  # each control is heard in a thread of its own

    def offer(self, checkbox: GuiInputHandle[bool], heard: Callable[[SceneNodePointerEvent], None]) -> None:
        """Let clicks go to ``heard`` while ``checkbox`` is ticked, which unticks the others."""
        checkbox.on_update(lambda _: self._follow(checkbox, heard))

    def _follow(self, checkbox: GuiInputHandle[bool], heard: Callable[[SceneNodePointerEvent], None]) -> None:
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
            self._around.on_click(heard)
            if former is not None:
                former.value = False
