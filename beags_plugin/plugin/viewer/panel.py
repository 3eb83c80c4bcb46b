"""The panel of a scene in nerfstudio's viewer: objects, legend, picking, export."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfstudio.viewer.viewer_elements import (
    ViewerButton,
    ViewerButtonGroup,
    ViewerClick,
    ViewerControl,
    ViewerDropdown,
    ViewerElement,
    ViewerParameter,
    ViewerSlider,
)

from beags_plugin.export import EXPORTERS
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.plugin.viewer.aim import frame_of, look, look_as, side_of_photos
from beags_plugin.plugin.viewer.clicks import SceneClicks
from beags_plugin.plugin.viewer.export import ShownFiles
from beags_plugin.plugin.viewer.legend import LegendRow, Listed, capitalised, escaped, legend, show_to_paste
from beags_plugin.plugin.viewer.pick_tab import PickTab
from beags_plugin.plugin.viewer.pick_work import take_picked
from beags_plugin.plugin.viewer.picking import under_cursor
from beags_plugin.plugin.viewer.serving import (
    Follower,
    end_when_interrupted,
    first_folder,
    hide_training_cameras,
    offer_whole_pictures,
    set_pace,
    show_text,
)
from beags_plugin.plugin.viewer.size_tab import SizeTab
from beags_plugin.plugin.viewer.viewed_run import ViewedRun
from beags_plugin.plugin.viewer.viewing import NO_CLASSES, Viewing
from beags_plugin.plugin.viewer.window import Windows, set_up_finished
from beags_plugin.system.errors import UserError

if TYPE_CHECKING:
    from nerfstudio.data.scene_box import OrientedBox
    from nerfstudio.viewer.viewer import Viewer
    from viser import ClientHandle, ViserServer

NONE = "none yet"  # Entry of the drop-down, which must have one, as long as no Gaussian has a class.
REFRESH_SECONDS = 0.3  # Time between two updates of the panel from scene and render threads.


class ObjectPanel(ViewerElement[None]):
    """All our controls as one element, because nerfstudio sorts elements by name.

    They change ``plugin.viewer.choice``, never the scene. Slow work runs in the panel's own threads: only the controls
    that pick and centre wait for a training step, and none runs in a render thread.
    """

    def __init__(self, viewing: Viewing) -> None:
        super().__init__("Objects")
        self.viewing = viewing
        self.listed = Listed()
        self.labels: dict[str, int] = {}
        self.notes: dict[str, str] = {}
        self.viewer: Viewer | None = None
        self._link: ViewerControl | None = None
        self._listening = False
        self._server: ViserServer | None = None
        self.clicks: SceneClicks | None = None
        self.pick_tab: PickTab | None = None
        self.size_tab: SizeTab | None = None
        self._windows: Windows | None = None
        self._legend: Any = None
        self._status: Any = None
        self.object = ViewerDropdown("Object", NONE, [NONE], hint="Also chosen by picking")
        # There are two rows, because four buttons in one are cut off.
        self.look = ViewerButtonGroup("Look at it", "Isolate", ["Isolate", "Show"], cb_hook=self._act)
        self.put_away = ViewerButtonGroup("Put it away", "Hide", ["Hide", "Remove"], cb_hook=self._act)
        self.show_all = ViewerButton("Show all objects", lambda _: self.choose(self.viewing.choice.show_all()))
        self.rest = ViewerSlider(
            "Rest", 0.0, 0.0, 1.0, 0.05, cb_hook=lambda slider: self._slide(faded_opacity=slider.value),
            hint="Opacity of what is hidden, or not isolated; removed objects stay invisible",
        )  # fmt: skip
        self.min_opacity = ViewerSlider(
            "Least opacity", 0.0, 0.0, 1.0, 0.01, cb_hook=lambda slider: self._slide(min_opacity=slider.value),
            hint="Weaker Gaussians are left out",
        )  # fmt: skip
        self.next_click = ViewerButton("Pick with the next click", lambda _: self.listen(not self._listening))
        self.files = ShownFiles(
            viewing, self.title, lambda: self.format.value, lambda text: self.note("export", text),
            scale_by=self._scale_by,
        )  # fmt: skip
        formats = EXPORTERS.names()
        self.format = ViewerDropdown("Format", "ply" if "ply" in formats else formats[0], formats)
        self.export = ViewerButton("Export what is shown", lambda _: self.files.start())

    # -- nerfstudio's side -------------------------------------------------------------------------------------------

    def install(self, viser_server: ViserServer) -> None:
        """Add the controls to the page, as its first folder: see ``ViewerElement.install``."""
        self.refresh_objects()
        self._server, gui = viser_server, viser_server.gui
        with first_folder(gui, "Objects") as self._folder:
            self.object.install(viser_server)
            self.next_click.install(viser_server)
            gui.add_button("Centre on this object").on_click(lambda event: self.centre(event.client))
            for element in (self.look, self.put_away, self.show_all, self.rest, self.min_opacity):
                element.install(viser_server)
            self._legend = gui.add_markdown("")
            self.format.install(viser_server)
            self.export.install(viser_server)
            self._status = gui.add_markdown("")
        self.look.value = self.put_away.value = ""

    def _create_gui_handle(self, viser_server: ViserServer) -> None:
        raise NotImplementedError("this element has no handle of its own")

    def attach(self, viewer: Viewer, link: ViewerControl) -> None:
        """Connect to a viewer that has installed the panel."""
        self.viewer, self._link = viewer, link
        run = ViewedRun(Path(viewer.log_filename).parent.absolute(), viewer.pipeline.datamanager)  # type: ignore[arg-type]
        if viewer.trainer is None and (damaged := take_picked(self.viewing.model, run.folder)):
            self.note("picked", damaged)
        self.viewing.attach(run, viewer.trainer is not None, viewer.train_lock)
        self.viewing.requested, self.viewing.crop_box = self._requested, self._crop_box
        if self._server is not None:
            self.clicks = clicks = SceneClicks(self._server)
            if viewer.trainer is None:  # Training renumbers the Gaussians.
                self.pick_tab = PickTab(self._server, self.viewing, self._listed, self._redraw, clicks, self._scale_by)
            self.size_tab = SizeTab(self._server, self.viewing, clicks)
            hide_training_cameras(viewer, lambda index: self._hit_camera(run.names[index]))
            if viewer.trainer is None:
                self._windows = set_up_finished(viewer)
        if run.note is not None:
            self.note("run", run.note)
        offer_whole_pictures(viewer.control_panel)
        if all(element is self for _, element in viewer.viewer_elements):
            self._folder.remove()
        viewer.viser_server.on_client_connect(self._joined)
        if viewer.trainer is None:
            end_when_interrupted(viewer.viser_server)
        self._begin_to_follow(viewer)

    def listen(self, listening: bool) -> None:
        """Start or stop waiting for the click that picks; only one, because the page's camera is fixed meanwhile."""
        if self._link is None or listening == self._listening:
            return
        self._listening = listening
        if listening:
            self._link.register_pointer_cb("click", self.clicked)
        else:
            self._link.unregister_pointer_cb()
        self.note("object", "Click an object in the picture; press again to cancel." if listening else "")

    def _joined(self, client: ClientHandle) -> None:
        """Set up a new page: the pace of its pictures, and a first camera at the objects."""
        assert self.viewer is not None
        set_pace(self.viewer, client.client_id, self.viewing.pace, self._windows)
        show_to_paste(client.gui)
        # It runs in a thread, because no message of the page is read while this function runs.
        threading.Thread(target=self.centre, args=(client, True), daemon=True).start()

    def centre(self, client: ClientHandle | None, first: bool = False) -> None:
        """Turn a page's camera to the chosen object; first: to all objects, from the side of the photos."""
        run, chosen = self.viewing.run, self.labels.get(self.object.value)
        class_ids = [class_id for class_id in self.labels.values() if (class_id if first else class_id == chosen)]
        if not class_ids and not first:
            self.note("object", f"Nothing to centre on: {NO_CLASSES}")
        if client is None or run is None:
            return
        if not class_ids:
            if first and self.pick_tab is not None:  # There are no objects yet.
                look_as(client, run.cameras)
            return
        frame = frame_of(*self.viewing.whole(), class_ids, run.cameras)
        look(client, frame, side_of_photos(frame, run.cameras) if first else None)

    def _hit_camera(self, name: str) -> None:
        """Report that a click hit a training camera, to which nerfstudio then moves the page."""
        text = f"The click hit the training camera of {name}, not the scene. Hide Train Cams, and click again."
        self.note("object", text)
        if self.pick_tab is not None:
            self.pick_tab.report(text)

    def _redraw(self) -> None:
        if self.viewer is not None:
            self.viewer._trigger_rerender()  # Nerfstudio's own controls call this; it takes no lock.

    # -- what is shown -----------------------------------------------------------------------------------------------

    def choose(self, choice: Any) -> None:
        """Show another choice."""
        self.viewing.choice = choice
        self._redraw()

    def _act(self, group: ViewerParameter) -> None:
        if action := group.value:
            self.act(action)
            group.value = ""  # Else viser would not report the same button of a group twice in a row.

    def act(self, action: str) -> None:
        """Apply a button to the chosen object: "Isolate", "Show", "Hide" or "Remove"."""
        class_id = self.labels.get(self.object.value)
        if class_id is None:
            self.note("object", f"Nothing to choose: {NO_CLASSES}")
            return
        self.choose(self.viewing.choice.after(action, class_id))

    def _slide(self, **values: float) -> None:
        self.choose(replace(self.viewing.choice, **values))

    def clicked(self, click: ViewerClick) -> None:
        """Choose the object under the cursor, and stop listening."""
        self.listen(False)
        try:
            gaussian = under_cursor(self.viewing, click.origin, click.direction)
        except UserError as error:
            self.note("object", capitalised(error))
            return
        label = next((label for label, class_id in self.labels.items() if class_id == gaussian.class_id), None)
        if label is not None and gaussian.class_id != BACKGROUND:
            self.object.value = label
        self.note("object", gaussian.sentence(label))

    def _scale_by(self) -> str:
        return "" if self.size_tab is None else self.size_tab.scale_by()

    def title(self) -> str:
        """Return the shown part in a few words, for a file's name."""
        return self.viewing.choice.title({class_id: label for label, class_id in self.labels.items()})

    # -- following the scene -------------------------------------------------------------------------------------------

    def _begin_to_follow(self, viewer: Viewer) -> None:
        Follower(viewer, self.follow, REFRESH_SECONDS, lambda text: self.note("panel", text)).start()

    def follow(self) -> None:
        """Update the panel."""
        self.refresh_objects()
        self._write_texts()

    def _requested(self) -> frozenset[str]:
        if self.viewer is None:
            return frozenset()
        controls = self.viewer.control_panel
        return frozenset({controls.output_render} | ({controls.split_output_render} if controls.split else set()))

    def _crop_box(self) -> OrientedBox | None:
        assert self.viewer is not None
        controls = self.viewer.control_panel
        return controls.crop_obb if controls.crop_viewport else None

    def refresh_objects(self) -> None:
        """List the classes that have Gaussians, under their present names."""
        if not self.listed.refresh(self.viewing.model):
            return
        self.labels = self.listed.labels
        options, former = list(self.labels) or [NONE], self.object.value
        if self.object.options != options:
            self.object.set_options(options)
            if former not in options:  # The first object is chosen rather than the background.
                self.object.value = next((label for label in options if self.labels.get(label)), options[0])

    def _listed(self) -> dict[str, int]:
        self.refresh_objects()
        return self.labels

    def note(self, about: str, text: str) -> None:
        """Show a note below the controls, instead of the last one about the same."""
        self.notes = {**self.notes, about: text}

    def _write_texts(self) -> None:
        """Write legend and notes, if they have changed."""
        choice = self.viewing.choice
        rows = [
            LegendRow(class_id, name, self.listed.counts[class_id], choice.state(class_id))
            for name, class_id in self.labels.items()
        ]
        lines = {**self.viewing.notes, **self.notes}
        pick = "" if self.pick_tab is None else " Without masks, pick objects in the tab Pick."
        texts = [legend(rows) if rows else escaped(f"No objects: {NO_CLASSES}{pick}")]
        texts.append("\n\n".join(escaped(line) for line in lines.values() if line))
        for handle, text in zip((self._legend, self._status), texts, strict=True):
            if handle is not None:
                show_text(handle, text)


class ViewerLink(ViewerControl):
    """Passes nerfstudio's viewer, once there is one, and clicks on the picture to the panel."""

    viewer: Viewer | None = None

    def __init__(self, panel: ObjectPanel) -> None:
        self.panel = panel

    def _setup(self, viewer: Viewer) -> None:
        super()._setup(viewer)
        self.panel.attach(viewer, self)
