"""The tab Size of a viewer: two clicks and the length between them give exported files a size."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from beags_plugin.export.pose_options import PoseOptions
from beags_plugin.objects.pose import metres_per_unit
from beags_plugin.plugin.viewer.aim import WORLD
from beags_plugin.plugin.viewer.clicks import SceneClicks
from beags_plugin.plugin.viewer.legend import capitalised, escaped
from beags_plugin.plugin.viewer.measure import Measure, place_under
from beags_plugin.plugin.viewer.pointing import page_camera
from beags_plugin.plugin.viewer.serving import another_tab, by_user, show_text
from beags_plugin.plugin.viewer.viewing import Viewing
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError

if TYPE_CHECKING:
    from viser import SceneNodePointerEvent, ViserServer

_MARK = "/beags_size"  # Name of the points, their labels and the line in the scene.
_COLOR = (255, 0, 200)  # A colour that few things have.
_RADIUS = 8.0  # Radius of a point in pixels of the page that clicked it.
_HELP = "Tick Click two points, and click on two whose distance you know; the mouse still turns the camera."


class SizeTab:
    """Controls of the length that sets the size of everything the viewer exports. clicks: on the picture."""

    def __init__(self, server: ViserServer, viewing: Viewing, clicks: SceneClicks) -> None:
        self.server = server
        self.viewing = viewing
        self.measure = Measure()
        self.note = ""
        self._marks: list[Any] = []
        self._changing = threading.Lock()  # Each control calls its listener in a thread of its own.
        gui = server.gui
        with another_tab(gui, "Size"):
            self.clicks = gui.add_checkbox("Click two points", False, hint="A drag turns the camera all the same")
            self.length = gui.add_text("Length", "", hint="From A to B, such as 12 cm; in mm, cm, m, in or ft")
            self.clear = gui.add_button("Without a size", hint="Removes points and length")
            self._status = gui.add_markdown("")
        clicks.offer(self.clicks, self.clicked)
        self.length.on_update(by_user(lambda: self.typed(self.length.value)))
        self.clear.on_click(lambda _: self.forget())
        self._write()

    def clicked(self, event: SceneNodePointerEvent) -> None:
        """Measure from or to the place under the cursor."""
        position, page = event.screen_pos, page_camera(event.client.camera)
        self._change(lambda: self.measure.clicked(place_under(self.viewing, position, page)))

    def typed(self, length: str) -> None:
        """Set the text of the length."""
        self._change(lambda: replace(self.measure, length=length))

    def forget(self) -> None:
        """Remove the size."""
        self.length.value = ""
        self._change(Measure)

    def scale_by(self) -> str:
        """Return the text of ``--scale-by``; empty without a size. Raises ``UserError`` for an incomplete measure."""
        return self.measure.scale_by(self._run().frame)

    def _run(self) -> Run:
        assert self.viewing.run is not None
        return self.viewing.run.opened()

    # -- what the tab shows ------------------------------------------------------------------------------------------

    def _change(self, change: Callable[[], Measure]) -> None:
        """Change the measure; a mistake changes nothing, and is shown."""
        with self._changing:
            try:
                former, self.measure, self.note = self.measure, change(), ""
            except UserError as error:
                self.note = str(error)
            else:
                if former.places is not self.measure.places:
                    self._draw()
                if len(self.measure.places) == 2 > len(former.places):
                    self.clicks.value = False
            self._write()

    def _draw(self) -> None:
        """Show the points and the line between them in the scene."""
        for mark in self._marks:
            mark.remove()
        scene, self._marks = self.server.scene, []
        points = [tuple((WORLD * place.point).tolist()) for place in self.measure.places]
        for name, point, place in zip("AB", points, self.measure.places, strict=False):
            radius = _RADIUS * WORLD * place.pixel
            self._marks.append(scene.add_icosphere(f"{_MARK}/{name}", radius, _COLOR, 2, position=point))
            self._marks.append(scene.add_label(f"{_MARK}/name_{name}", name, position=point))
        if len(points) == 2:
            line = scene.add_spline_catmull_rom(f"{_MARK}/line", tuple(points), line_width=3.0, color=_COLOR)
            self._marks.append(line)

    def _text(self) -> str:
        """Return Markdown: a mistake, what is missing, or the size with its option of the command line."""
        if self.note:
            return escaped(capitalised(self.note))
        if not self.measure.places and not self.measure.length.strip():
            return escaped(_HELP)
        try:
            run = self._run()
            text = self.measure.scale_by(run.frame)
            length = PoseOptions(scale_by=text).length()
            assert length is not None
            metres = metres_per_unit(length, run, run.frame)
        except UserError as error:
            return escaped(capitalised(error))
        size = f"A unit of the input is {metres:.4g} m. What is exported here is in metres, stl and 3mf in millimetres."
        return f'{escaped(size)}\n\nThe same for beags export:\n\n`--scale-by "{text}"`'

    def _write(self) -> None:
        show_text(self._status, self._text())
