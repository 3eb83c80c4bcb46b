"""Picking in a viewer: the picked objects, and the slow work for them in a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from beags_plugin.core.membership import Membership
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.labels.colors import colorize
from beags_plugin.objects.picked_masks import save_masks
from beags_plugin.picking.cutter import Cutter, takes_little, takes_much
from beags_plugin.picking.picks import Picks
from beags_plugin.plugin.training.scene_model import SceneModel
from beags_plugin.plugin.viewer.choice import Visible
from beags_plugin.plugin.viewer.legend import capitalised
from beags_plugin.plugin.viewer.other_sides import sides_picture
from beags_plugin.plugin.viewer.viewing import Paint, Viewing
from beags_plugin.runs.picked import with_picked, write_picked
from beags_plugin.runs.run import Run
from beags_plugin.system.errors import UserError
from beags_plugin.system.progress import say

_CHOSEN, _OTHERS = 0.65, 0.4  # Strength of the colours over the chosen object and over the other picked ones.
FIRST_COLOR = 3  # Index in ``colorize`` of a colour that few things have.
Step = Callable[[Picks], Picks]


def take_picked(model: SceneModel, run: Path) -> str | None:
    """Set a model's classes to those picked in an earlier session; return a sentence if their file is damaged."""
    trained = model.state_dict()
    try:
        picked = with_picked(trained, run)
    except UserError as error:
        return str(error)
    if picked is not trained:
        extra = picked["_extra_state"]
        model.take_members(Membership(picked["class_ids"], extra.get("objects")))
        model.classes = dict(extra["classes"])
    return None


class PickWork:
    """The objects picked in a finished scene; each method returns at once.

    One thread does the steps in their order, so that neither pictures nor the page wait for a cut. A step that fails
    changes nothing. report: receives a sentence, and the next command if there is one. changed: is called after every
    step. pictured: receives Markdown of the chosen object from other sides, or "".
    """

    def __init__(
        self, viewing: Viewing, report: Callable[..., None], changed: Callable[[], None],
        pictured: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.picks = Picks() if viewing.errand is None else viewing.errand.picks()
        self.alone = False
        self._viewing = viewing
        self._report = report
        self._changed = changed
        self._pictured = pictured
        self._history: list[Picks] = []
        self._doubt = ""  # The doubt reported at the last Save as masks.
        self._made: Cutter | None = None
        self._pictured_members: Tensor | None = None  # Members of the object in the pictures of other sides.
        self._steps: queue.SimpleQueue[Callable[[], str]] = queue.SimpleQueue()
        threading.Thread(target=self._work, name="beags pick", daemon=True).start()

    # -- steps -------------------------------------------------------------------------------------------------------

    def cut(self, step: Callable[[Cutter, Picks], Picks]) -> None:
        """Change the chosen object by a step that cuts, and can be undone."""

        def do() -> str:
            cutter, began = self._cutter(), time.perf_counter()
            former, self.picks = self.picks, step(cutter, self.picks)
            self._history.append(former)
            return self._summary(former.chosen.members, time.perf_counter() - began)

        self._steps.put(do)

    def change(self, step: Step) -> None:
        """Choose or name an object; this is never undone."""

        def do() -> str:
            self.picks = step(self.picks)
            return ""

        self._steps.put(do)

    def undo(self) -> None:
        """Undo the last cut."""

        def do() -> str:
            if not self._history:
                raise UserError("there is nothing to undo.")
            names, former = [one.name for one in self.picks.objects], self._history.pop()
            named = tuple(replace(one, name=name) for one, name in zip(former.objects, names, strict=False))
            self.picks = replace(former, objects=(*named, *self.picks.objects[len(named) :]))
            return self._summary()

        self._steps.put(do)

    def show_alone(self, alone: bool) -> None:
        """Show the chosen object without the rest, or with it."""

        def do() -> str:
            self.alone = alone
            return ""

        self._steps.put(do)

    def save_masks(self, folder: Path | None = None, ended: Callable[[], None] | None = None) -> None:
        """Render all objects into masks of the training views; see ``picked_masks.save_masks``.

        ended: called once the masks of an errand are saved; its doubts stop only the first attempt.
        """

        def do() -> str:
            errand = self._viewing.errand
            if errand is not None and (doubt := errand.doubt(self.picks) or "") not in ("", self._doubt):
                self._doubt = doubt
                return doubt
            members, names = self._viewing.model.members(), self._viewing.model.classes
            if self.picks.changed() or not any(members.present()):  # Else the run's own objects are saved.
                members, names = self.picks.applied(members, names)
            self._report("Rendering masks of all training views ...")
            if errand is not None:  # Classes of masks that the scene may have are left out.
                names = {each: name for each, name in names.items() if each in (BACKGROUND, *members.present())}
            saved = save_masks(self._opened(), members, names, folder)
            if ended is not None:
                say(saved.said)
                self._report(f"{saved.said} The viewer closes now; the program that opened it goes on.")
                ended()
                return ""
            say(f"{saved.said} To refine with them:\n{saved.command}")
            self._report(saved.said, saved.command)
            return ""

        self._steps.put(do)

    def keep(self) -> None:
        """Store the picked objects as objects of the run; this cannot be undone."""

        def do() -> str:
            viewing, model = self._viewing, self._viewing.model
            members, names = self.picks.applied(model.members(), model.classes)
            path = write_picked(self._opened().folder, model.means, members, names)
            with viewing.lock:
                model.take_members(members)
                model.classes = names
            self.picks, self._history, self.alone = Picks(), [], False
            return f"Kept in {path}: the objects are the run's now, for every command."

        self._steps.put(do)

    # -- reading -----------------------------------------------------------------------------------------------------

    def rendered(self) -> Tensor | None:
        """Return [N] bool, the Gaussians that the viewer renders; None: all."""
        index = self._viewing.visible().index
        if index is None:
            return None
        rendered = torch.zeros(self._viewing.model.num_points, dtype=torch.bool)
        rendered[index.cpu()] = True
        return rendered

    def part(self) -> Visible:
        """Return the chosen object's Gaussians, for a file; raises ``UserError`` if it has none."""
        members = self.picks.chosen.members
        if members is None:
            raise UserError(f"nothing of {self.picks.chosen.name} has been picked yet: click on it first.")
        surfels = self._viewing.whole()[0]
        index = members.nonzero()[:, 0].to(surfels.means.device)
        return Visible(surfels[index], torch.ones(len(index), dtype=torch.int32, device=index.device), index)

    def _opened(self) -> Run:
        assert self._viewing.run is not None
        return self._viewing.run.opened()

    def _summary(self, former: Tensor | None = None, seconds: float | None = None) -> str:
        one = self.picks.chosen
        if one.members is None:
            return f"{one.name}: nothing yet."
        count = int(one.members.sum())
        more = ""
        if former is not None:
            added, lost = int((one.members & ~former).sum()), int((former & ~one.members).sum())
            more = f", {added:,} more and {lost:,} fewer than before"
        took = "" if seconds is None else f" ({seconds:.1f} s)"
        remark = takes_much(one.members) or takes_little(one.members)
        return f"{one.name}: {count:,} Gaussians{more}{took}." + (f" This is {remark}." if remark else "")

    # -- the thread --------------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while True:
            step = self._steps.get()
            try:
                message = step()
            except UserError as error:
                message = f"{capitalised(error)} Nothing has been changed."
            except Exception as error:  # Nothing else reports an exception of a thread.
                message = f"Nothing has been changed ({type(error).__name__}: {error})."
            self._viewing.paint = self._paint()
            if message:
                self._report(message)
            self._changed()
            if self._steps.empty():
                self._picture()

    def _picture(self) -> None:
        """Show the chosen object from sides that were not clicked, unless they are shown already."""
        one, paint = self.picks.chosen, self._viewing.paint
        if one.members is self._pictured_members:
            return
        self._pictured_members, text = one.members, None
        if one.members is not None and paint is not None:
            clicked = [view.camera.center for view in one.marks]
            try:
                text = sides_picture(self._viewing, one.members, clicked, replace(paint, only=None))
            except Exception as error:  # Nothing else reports an exception of a thread.
                self._report(f"No pictures of other sides ({type(error).__name__}: {error}).")
        self._pictured(text or "")

    def _cutter(self) -> Cutter:
        viewing = self._viewing
        if self._made is None:
            assert viewing.run is not None
            surfels, model = viewing.whole()[0], viewing.model

            def progress(done: int, total: int) -> None:
                self._report(f"Getting ready, once: {done} of {total} views are done.")

            self._made = Cutter(surfels, viewing.run.cameras, model.rasterizer, model.settings(), progress)
        return self._made

    def _paint(self) -> Paint | None:
        """Return the colours of the picked objects."""
        picks, device = self.picks, self._viewing.model.device
        if all(one.members is None for one in picks.objects):
            return None
        owners = picks.owners(self._viewing.model.num_points)
        table = torch.from_numpy(colorize(np.arange(len(picks.objects))[None] + FIRST_COLOR)[0]).float() / 255.0
        strength = torch.where(owners == picks.place, _CHOSEN, _OTHERS) * (owners >= 0)
        only = None
        if self.alone and picks.chosen.members is not None:
            only = picks.chosen.members.to(device)
            strength = torch.zeros_like(strength)
        return Paint(table[owners.clamp_min(0)].to(device), strength.float().to(device), only)
