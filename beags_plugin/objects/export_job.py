"""The work of an export: each item in the frame of its files, given to the exporters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from beags_plugin.core.select import select_class
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import Exporter
from beags_plugin.export.pose_options import PoseOptions
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.clean import Cleaner
from beags_plugin.objects.exported import Exported, ExportedFile
from beags_plugin.objects.photos import photos_of
from beags_plugin.objects.pose import plane_under
from beags_plugin.objects.shown import Shown
from beags_plugin.runs.read import SavedScene
from beags_plugin.surfaces.closing_gaussians import with_closing
from beags_plugin.surfaces.frames import Frame, bounding_box
from beags_plugin.surfaces.ground_plane import turn_to_z
from beags_plugin.surfaces.item import ExportItem, NothingToExport, Photo, Viewpoints
from beags_plugin.surfaces.mesh_options import MeshOptions

Progress = Callable[[int, int], None]


class Steps:
    """Reports the progress of an export: a step for each piece, after one for each view that it renders.

    of_a_piece: steps of each piece of an item: of its closing, if any, and of each file.
    """

    def __init__(self, of_a_piece: Sequence[int], items: int, report: Progress) -> None:
        self._of_pieces = list(of_a_piece) * items
        self._piece = 0
        self._report = report
        self.on_render(0)

    def on_render(self, views: int) -> None:
        """Report the rendered views of the current piece."""
        self._report(sum(self._of_pieces[: self._piece]) + views, sum(self._of_pieces))

    def finish(self) -> None:
        """Report the current piece as done."""
        self._piece += 1
        self.on_render(0)


@dataclass(frozen=True)
class ExportJob:
    """The common settings of all items of an export.

    world: the input's frame. metres: metres in a unit of it, or None if files keep its unit. centred: whether the
    origin is the middle of each item. views: in the run's frame. tolerant: whether to leave out a format for which an
    item has nothing. cleaner: decides what belongs to an object; None for all. closing: options of the surface by which
    objects are closed where no photo shows them; None to close nothing. local: the world's frame around an origin near
    the scene, in which files are made if the world is far from 0. shift: [3] float64, that origin, if files that can
    hold double precision are to have the world's coordinates.
    """

    scene: SavedScene
    exporters: Mapping[str, Exporter]
    world: Frame
    metres: float | None
    centred: bool
    pose: PoseOptions
    views: Viewpoints | None
    tolerant: bool
    cleaner: Cleaner | None
    shown: Shown
    closing: MeshOptions | None
    local: Frame | None = None
    shift: torch.Tensor | None = None

    def steps(self) -> list[int]:
        """Return the steps of each piece of an item: see ``Steps``."""
        views = 0 if self.views is None else len(self.views.cameras)
        files = [1 + (views if exporter.needs_views else 0) for exporter in self.exporters.values()]
        return [1 + views, *files] if self._adds_gaussians() else files

    def _adds_gaussians(self) -> bool:
        return self.closing is not None and any(exporter.holds_gaussians for exporter in self.exporters.values())

    def export(self, name: str, class_id: int | None, stem: Path, steps: Steps) -> Exported:
        """Write all files of one class (None: of the whole scene), named ``stem`` and a suffix."""
        class_ids, chosen, left_out = self.scene.members.class_ids, self.scene.surfels(), None
        if class_id is not None:
            chosen, index = select_class(chosen, self.scene.members, class_id)
            if self.cleaner is not None and class_id != BACKGROUND:
                chosen, index, left_out = self.cleaner.clean(chosen, index, class_id)
            class_ids = torch.full_like(class_ids[index], class_id)
        try:
            frame, doubt = self._frame(name, chosen, class_id), None
        except NothingToExport as error:
            if not self.tolerant:
                raise
            frame, doubt = self.local or self.world, error
        views = None if self.views is None else frame.views(self.views)
        photos, no_photos = self._photos(class_id, chosen, frame)
        item = ExportItem(
            name, frame.surfels(chosen), class_ids, views, on_render=steps.on_render, photos=photos,
            no_photos=no_photos, in_metres=self.metres is not None,
            close=self.closing is not None and class_id not in (None, BACKGROUND), class_names=self.scene.classes,
        )  # fmt: skip
        of_splats, added = item, None
        if self.closing is not None and self._adds_gaussians():
            if item.close and doubt is None:
                of_splats, added = with_closing(item, self.closing)
            steps.finish()
        files = []
        for label, exporter in self.exporters.items():
            path = stem.with_name(f"{stem.name}.{exporter.suffix}")
            of_file = of_splats if exporter.holds_gaussians else item
            files.append(
                self._write(label, exporter, path, of_file, class_id)
                if doubt is None
                else ExportedFile(label, None, {}, str(doubt))
            )
            steps.finish()
        low, high = bounding_box(item.surfels)
        origin, above = self.world.points(frame.in_run(torch.tensor([[0.0] * 3, [0.0, 0.0, 1.0]], dtype=torch.float64)))
        up = (above - origin) / (above - origin).norm()
        return Exported(
            name, class_id, len(chosen), origin.tolist(), up.tolist(), low.tolist(), high.tolist(), frame.to_run(),
            files, left_out, added,
        )  # fmt: skip

    def _frame(self, name: str, part: Surfels, class_id: int | None) -> Frame:
        """Return the frame of the files of an item; raise ``NothingToExport`` if it stands on nothing.

        part: its Gaussians, in the run's frame.
        """
        world = self.local or self.world
        frame, floor = world if self.metres is None else world.scaled(self.metres), None
        if (direction := self.pose.direction()) is not None:
            frame = frame.turned(turn_to_z(torch.tensor(direction, dtype=torch.float64)))
        elif self.pose.up and class_id not in (None, BACKGROUND):
            scene, doubt = self.shown.scene()
            if scene is None:
                raise NothingToExport(
                    f"what {name!r} stands on is not known, as {doubt}: name the direction with --up."
                )
            plane = plane_under(name, part, class_id, scene, frame)
            frame, floor = frame.turned(turn_to_z(plane.normal)), plane.offset
        if not (self.centred or self.pose.centre):
            return frame
        low, high = bounding_box(frame.surfels(part))
        center = (low + high) / 2
        if self.pose.centre:
            center[2] = low[2] if floor is None else floor
        return frame.centred(center)

    def _photos(self, class_id: int | None, part: Surfels, frame: Frame) -> tuple[Sequence[Photo] | None, str]:
        """Return the photos of an item in ``frame``, if an exporter needs them, or None and why there are none."""
        if not any(exporter.needs_photos for exporter in self.exporters.values()):
            return None, "no exporter needs photos"
        scene, doubt = self.shown.scene()
        photos = None if scene is None else photos_of(scene, class_id, part, frame)
        return (photos, "") if photos else (None, doubt or "no photo shows it")

    def _write(
        self, label: str, exporter: Exporter, path: Path, item: ExportItem, class_id: int | None
    ) -> ExportedFile:
        note = {}
        if self.tolerant and class_id == BACKGROUND:
            if (quick := exporter.without_mesh()) is None:
                reason = "a mesh of the background takes long: name it with --object if you want it"
                return ExportedFile(label, None, {}, reason)
            note = {} if quick is exporter else {"mesh": "none, as one of the background takes long"}
            exporter = quick
        try:
            facts = {**exporter.write(path, item), **note}
            if self.shift is not None:
                in_world = exporter.to_world(path, self.shift)
                facts = {**facts, **({"coordinates": "world"} if in_world else {"origin": self.shift.tolist()})}
            return ExportedFile(label, path, facts)
        except NothingToExport as error:
            if not self.tolerant:
                raise
            return ExportedFile(label, None, {}, str(error))
