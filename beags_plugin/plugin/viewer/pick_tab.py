"""The tab Pick of a viewer: the user picks objects by clicks and boxes in the picture."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from beags_plugin.export import EXPORTERS
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.picked_masks import masks_folder
from beags_plugin.picking.cutter import ViewMarks
from beags_plugin.plugin.viewer.clicks import SceneClicks
from beags_plugin.plugin.viewer.export import ShownFiles
from beags_plugin.plugin.viewer.legend import LegendRow, legend, pasteable, unique_labels, wrapped
from beags_plugin.plugin.viewer.pick_work import FIRST_COLOR, PickWork
from beags_plugin.plugin.viewer.pointing import box_mark, click_mark, page_camera
from beags_plugin.plugin.viewer.serving import another_tab, by_user, show_text
from beags_plugin.plugin.viewer.viewing import Viewing

if TYPE_CHECKING:
    from viser import SceneNodePointerEvent, ScenePointerEvent, ViserServer

_OF_RUN = "{} (of the run)"  # Label of an object of the run, which can be corrected.
_HELP = "Tick Click to pick, and click on an object; the mouse still turns the camera."


class PickTab:
    """Controls for the meaning of the next click on the picture, and for the use of the picked objects.

    labels: returns the run's objects that have Gaussians, label to class id. redraw: requests new pictures. clicks: on
    the picture. scale_by: returns the size of exported files: see ``PoseOptions``.
    """

    def __init__(
        self, server: ViserServer, viewing: Viewing, labels: Callable[[], dict[str, int]], redraw: Callable[[], None],
        clicks: SceneClicks, scale_by: Callable[[], str],
    ) -> None:  # fmt: skip
        self.server = server
        self.viewing = viewing
        self.note = self._help = _HELP if viewing.errand is None else viewing.errand.help()
        self.command = ""
        self._labels = labels
        self._redraw = redraw
        self._boxing = False
        self._entries: dict[str, tuple[str, int]] = {}
        self._named: tuple[int, str] | None = None  # place and name of the object whose name the control last got
        self.work = PickWork(viewing, self.report, self.refresh, self.picture)
        gui = server.gui
        formats = EXPORTERS.names()
        errand = viewing.errand
        with another_tab(gui, "Pick", first=errand is not None):
            self.picked = gui.add_dropdown("Picked", ["object 1"], hint="The object of the next click")
            self.name = gui.add_text("Name", "object 1")
            self.new = gui.add_button("Another object")
            self.clicks = gui.add_checkbox("Click to pick", False, hint="A drag turns the camera all the same")
            self.excludes = gui.add_checkbox("Exclude", False, hint="Clicks and boxes mark what does not belong to it")
            self.box = gui.add_button("Drag a box", hint="Nothing outside of it belongs to the object")
            self.size = gui.add_button_group("Size", ["Grow", "Shrink"])
            self.undo = gui.add_button("Undo")
            self.alone = gui.add_checkbox("Only what is picked", False)
            self._status = gui.add_markdown("")
            self._sides = gui.add_markdown("")
            self.format = gui.add_dropdown("As", formats, "ply" if "ply" in formats else formats[0])
            self.export = gui.add_button("Export the picked object")
            self.folder = gui.add_text(
                "Masks to", str(self._usual_folder()), disabled=errand is not None,
                hint="Folder that Save as masks writes",
            )  # fmt: skip
            self.masks = gui.add_button("Save as masks", hint="Of all objects, for the training views")
            self._where = gui.add_markdown("")
            self.keep = gui.add_button("Keep in the run", hint="As its objects, for every command")
        self.files = ShownFiles(viewing, self._title, lambda: self.format.value, self.report, self.work.part, scale_by)
        clicks.offer(self.clicks, self.clicked)
        self._say_where()
        self._listen()
        self.refresh()
        if errand is not None:
            self.keep.visible = False
            self.clicks.value = True
            errand.serve(server)

    def _listen(self) -> None:
        self.picked.on_update(by_user(lambda: self._choose(self.picked.value)))
        self.name.on_update(by_user(lambda: self._rename(self.name.value)))
        self.new.on_click(lambda _: self.work.change(lambda picks: picks.another()))
        self.box.on_click(lambda _: self.take_box(not self._boxing))
        self.size.on_click(lambda event: self._grow({"Grow": 1, "Shrink": -1}[event.target.value]))
        self.undo.on_click(lambda _: self.work.undo())
        self.alone.on_update(by_user(lambda: self.work.show_alone(self.alone.value)))
        self.export.on_click(lambda _: self.files.start())
        self.folder.on_update(lambda _: self._say_where())
        self.masks.on_click(lambda _: self._save())
        self.keep.on_click(lambda _: self.work.keep())

    # -- pointing ----------------------------------------------------------------------------------------------------

    def clicked(self, event: SceneNodePointerEvent) -> None:
        """Mark what is under the cursor."""
        if self._boxing:
            return
        inside, position, camera = not self.excludes.value, event.screen_pos, page_camera(event.client.camera)
        self._mark(lambda _: click_mark(position, camera, inside, self.work.rendered()))

    def take_box(self, waiting: bool) -> None:
        """Start or stop waiting for a box; the page's camera is fixed meanwhile."""
        if waiting == self._boxing:
            return
        self._boxing = waiting
        if waiting:
            self.server.scene.on_pointer_event("rect-select")(self.boxed)
            self.report("Drag a box over the picture; press again to cancel.")
        else:
            self.server.scene.remove_pointer_callback()
            self.report(self._help)

    def boxed(self, event: ScenePointerEvent) -> None:
        """Mark a box."""
        self.take_box(False)
        inside, corners, camera = not self.excludes.value, event.screen_pos, page_camera(event.client.camera)

        def mark(pointed: bool) -> ViewMarks:
            return box_mark(corners, camera, inside, self.work.rendered(), inside and not pointed)

        self._mark(mark)

    def _mark(self, mark: Callable[[bool], ViewMarks]) -> None:
        self.report("Cutting ...")
        self.work.cut(
            lambda cutter, picks: picks.marked(cutter, mark(any(any(each.inside) for each in picks.chosen.marks)))
        )

    def _grow(self, steps: int) -> None:
        self.report("Cutting ...")
        self.work.cut(lambda cutter, picks: picks.grown(cutter, steps))

    # -- objects -----------------------------------------------------------------------------------------------------

    def _choose(self, label: str) -> None:
        kind, number = self._entries.get(label, ("", 0))
        if kind == "picked":
            self.work.change(lambda picks: picks.choose(number))
        elif kind == "run":
            members = self.viewing.model.members().of(number).cpu()
            name = self.viewing.model.classes[number]
            self.work.change(lambda picks: picks.correcting(name, number, members))

    def _rename(self, name: str) -> None:
        if name != self.work.picks.chosen.name:
            self._named = self.work.picks.place, name
            self.work.change(lambda picks: picks.named(name))

    def _save(self) -> None:
        errand = self.viewing.errand
        self.work.save_masks(self._folder(), None if errand is None else lambda: errand.end(self.server))

    def _title(self) -> str:
        return f"picked_{self.work.picks.chosen.name}"

    # -- what the tab shows ------------------------------------------------------------------------------------------

    def report(self, text: str, command: str = "") -> None:
        """Show a sentence below the controls, instead of the last one. command: to paste into a terminal."""
        self.note = text
        if command:
            self.command = command
            self._say_where()
        self._write()

    def picture(self, text: str) -> None:
        """Show pictures of the chosen object, as Markdown."""
        show_text(self._sides, f"From sides that were not clicked:\n\n{text}" if text else "")

    def _usual_folder(self) -> Path:
        assert self.viewing.run is not None
        errand = self.viewing.errand
        return masks_folder(self.viewing.run.folder) if errand is None else errand.folder

    def _folder(self) -> Path:
        typed = self.folder.value.strip()
        return Path(typed).expanduser() if typed else self._usual_folder()

    def _say_where(self) -> None:
        ends = "" if self.viewing.errand is None else ", and ends the viewer: the program that opened it goes on"
        where = wrapped(f"Save as masks writes to {self._folder()}{ends}")
        after = f"\n\nRefine with the saved masks:\n\n{pasteable(self.command)}" if self.command else ""
        show_text(self._where, where + after)

    def refresh(self) -> None:
        """Show the picked objects."""
        picks = self.work.picks
        corrected = {one.class_id for one in picks.objects}
        places = unique_labels({place: one.name for place, one in enumerate(picks.objects)})
        entries = {label: ("picked", place) for label, place in places.items()}
        for label, class_id in self._labels().items():
            if class_id != BACKGROUND and class_id not in corrected:
                entries[_OF_RUN.format(label)] = ("run", class_id)
        self._entries = entries
        with suppress(KeyError):  # The viewer may be closing.
            if tuple(entries) != tuple(self.picked.options):
                self.picked.options = tuple(entries)
            self._set(self.picked, next(label for label, place in places.items() if place == picks.place))
            if (picks.place, picks.chosen.name) != self._named:  # else the user may be typing another name
                self._named = picks.place, picks.chosen.name
                self._set(self.name, picks.chosen.name)
            self._set(self.alone, self.work.alone)
        self._write()
        self._redraw()

    @staticmethod
    def _set(control: Any, value: Any) -> None:
        if control.value != value:
            control.value = value

    def _write(self) -> None:
        rows = [
            LegendRow(place + FIRST_COLOR, one.name, int(one.members.sum()))
            for place, one in enumerate(self.work.picks.objects)
            if one.members is not None
        ]
        show_text(self._status, "\n\n".join([*([legend(rows)] if rows else []), wrapped(self.note)]))
