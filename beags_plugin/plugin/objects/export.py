"""Export of runs: files for other programs, of each object and of the background."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from beags_plugin.cleaning.clean import LeftOut
from beags_plugin.core.surfels import Surfels
from beags_plugin.export.base import Exporter, ExportItem, NothingToExport, Viewpoints, make_exporter
from beags_plugin.export.frames import Frame, bounding_box, check_placement
from beags_plugin.extraction.files import whole_file
from beags_plugin.extraction.select import select_class
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.plugin.objects.clean import Cleaner, cleaner_of
from beags_plugin.plugin.objects.extract import file_name, folder_names, objects_with_gaussians
from beags_plugin.plugin.runs.place import open_run
from beags_plugin.plugin.runs.read import (
    SavedScene,
    raster_settings,
    read_assigned_run,
    read_run,
    read_transform,
    training_viewpoints,
)
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.system.errors import UserError

MANIFEST = "manifest.json"
WHOLE = "whole scene"  # the name of the file that holds all Gaussians
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class ExportedFile:
    """One file: its format, its path and its exporter's facts; path None: nothing to write, for ``reason``."""

    format: str
    path: Path | None
    facts: dict[str, Any]
    reason: str = ""


@dataclass(frozen=True)
class Exported:
    """One object (or the background, or the whole scene) and its files.

    class_id: None of the whole scene. center: [3] the point of the world that is the files' origin. low, high: [3] its
    box, in the files' frame. to_run: the 4 x 4 matrix from the files' frame to the run's normalised one. left_out:
    Gaussians of the object that do not belong to it; None where none was looked for.
    """

    name: str
    class_id: int | None
    gaussians: int
    center: list[float]
    low: list[float]
    high: list[float]
    to_run: list[list[float]]
    files: list[ExportedFile]
    left_out: LeftOut | None = None

    def to_json(self, folder: Path) -> dict[str, Any]:
        """Return plain values for the manifest in ``folder``."""
        return {
            "name": self.name,
            "class_id": self.class_id,
            "gaussians": self.gaussians,
            **({} if self.left_out is None else {"left_out_gaussians": asdict(self.left_out)}),
            "center": self.center,
            "box": {"low": self.low, "high": self.high},
            "to_run": self.to_run,
            "files": [
                {"format": file.format, "path": file.path.relative_to(folder).as_posix()}
                | {"bytes": file.path.stat().st_size, **file.facts}
                for file in self.files
                if file.path is not None
            ],
            "left_out": [{"format": file.format, "reason": file.reason} for file in self.files if file.path is None],
        }


def export_run(
    config_path: Path,
    objects: Sequence[str] = (),
    everything: bool = False,
    formats: Sequence[str] = ("ply",),
    placement: str = "world",
    output: Path | None = None,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Progress | None = None,
    whole: bool = False,
    data: Path | None = None,
    keep_all: bool = False,
) -> list[Exported]:
    """Write files of objects of a run.

    config_path: config.yml of a refined (or assigned) run. objects: names; or everything: all that have Gaussians and
    the emptied background, and a manifest. whole: the whole scene too, in one file; alone it needs no classes. formats:
    names of exporters. placement: "world", the frame of the input poses (the run's own if it has not kept how that was
    normalised), or "object", the same centred on each object. output: folder; ``exports/`` in the run by default.
    options: format to its exporter's options. progress: receives (done, total) files, and rendered views of the meshes
    among them. data: if not where they were. keep_all: keep Gaussians too that do not belong to their object
    (``cleaning.clean``); the background and the whole scene are kept as they are. Raises ``UserError`` for a mistake,
    before anything is written.
    """
    run, folder = config_path.parent, output or config_path.parent / "exports"
    check_placement(placement)
    exporters = {name: make_exporter(name, **(options or {}).get(name, {})) for name in formats}
    if not exporters:
        raise UserError("no format is named: name one with --format.")
    read = read_assigned_run if everything or objects or not whole else read_run
    scene = read(config_path, data)
    present = objects_with_gaussians(scene, objects, run) if scene.assigned else {}
    if everything and objects:
        raise UserError("--all exports every object: leave --object out.")
    if not (everything or objects or whole):
        raise UserError(
            f"nothing to export is named: use --all, --whole, or --object with one of {', '.join(present)}."
        )
    transform = read_transform(run)
    frame = Frame.of_run() if transform is None else Frame(*transform)
    views = None
    if any(exporter.needs_views for exporter in exporters.values()):
        views = training_viewpoints(scene.config, raster_settings(scene), config_path)
    names, titles = list(present) if everything else list(dict.fromkeys(objects)), folder_names(scene.classes)
    cleaner = None if keep_all or not any(map(present.get, names)) else cleaner_of(scene, config_path)
    job = _Job(scene, exporters, frame, placement == "object", views, everything, cleaner)
    items: list[tuple[str, int | None, str]] = [(name, present[name], titles[present[name]]) for name in names]
    if whole:
        items.append((WHOLE, None, "whole_scene"))
    steps = _Steps(job.steps(), len(items), progress or (lambda done, total: None))
    exported = [job.export(name, class_id, folder / title, steps) for name, class_id, title in items]
    if everything:
        world = "run" if transform is None else "input"
        content = {
            "run": str(config_path.absolute()),
            "frame": placement,
            "world": world,
            "objects": [one.to_json(folder) for one in exported],
        }
        with whole_file(folder / MANIFEST) as part:
            part.write_text(json.dumps(content, indent=2), "utf8")
    return exported


class _Steps:
    """Reports the progress of an export: a step for each file, and before it one for each view that it renders.

    of_a_piece: steps of each exporter's file.
    """

    def __init__(self, of_a_piece: Sequence[int], items: int, report: Progress) -> None:
        self._of_files = list(of_a_piece) * items
        self._file = 0
        self._report = report
        self.on_render(0)

    def on_render(self, views: int) -> None:
        """Report the rendered views of the present file."""
        self._report(sum(self._of_files[: self._file]) + views, sum(self._of_files))

    def wrote(self) -> None:
        """Report the present file as done."""
        self._file += 1
        self.on_render(0)


@dataclass(frozen=True)
class _Job:
    """The common settings of all items of an export.

    world: frame of the files, but for the shift if they are ``centred``. views: in the run's frame. tolerant: leave out
    a format for which an item has nothing. cleaner: decides what belongs to an object; None: all.
    """

    scene: SavedScene
    exporters: Mapping[str, Exporter]
    world: Frame
    centred: bool
    views: Viewpoints | None
    tolerant: bool
    cleaner: Cleaner | None

    def steps(self) -> list[int]:
        """Return the steps of each file of an item: see ``_Steps``."""
        views = 0 if self.views is None else len(self.views.cameras)
        return [1 + (views if exporter.needs_views else 0) for exporter in self.exporters.values()]

    def export(self, name: str, class_id: int | None, stem: Path, steps: _Steps) -> Exported:
        """Write all files of one class (None: of the whole scene), called ``stem`` and their suffixes."""
        class_ids, chosen, left_out = self.scene.members.class_ids, self.scene.surfels(), None
        if class_id is not None:
            chosen, index = select_class(chosen, self.scene.members, class_id)
            if self.cleaner is not None and class_id != BACKGROUND:
                chosen, index, left_out = self.cleaner.clean(chosen, index, class_id)
            class_ids = torch.full_like(class_ids[index], class_id)
        low, high = bounding_box(self.world.surfels(chosen))
        center = (low + high) / 2 if self.centred else torch.zeros(3, dtype=torch.float64)
        frame = self.world.centred(center)
        views = None if self.views is None else frame.views(self.views)
        item = ExportItem(name, frame.surfels(chosen), class_ids, views, on_render=steps.on_render)
        files = []
        for label, exporter in self.exporters.items():
            files.append(self._write(label, exporter, stem.with_name(f"{stem.name}.{exporter.suffix}"), item))
            steps.wrote()
        low, high = low - center, high - center
        return Exported(
            name, class_id, len(chosen), center.tolist(), low.tolist(), high.tolist(), frame.to_run(), files, left_out
        )

    def _write(self, label: str, exporter: Exporter, path: Path, item: ExportItem) -> ExportedFile:
        try:
            return ExportedFile(label, path, exporter.write(path, item))
        except NothingToExport as error:
            if not self.tolerant:
                raise
            return ExportedFile(label, None, {}, str(error))


def export_shown(
    config_path: Path,
    surfels: Surfels,
    class_ids: Tensor,
    title: str,
    format_name: str,
    settings: RasterSettings,
    progress: Progress = lambda done, total: None,
) -> Path:
    """Write Gaussians that a viewer shows into ``exports/`` of the run, without replacing a file; return the path.

    config_path: config.yml of the run. surfels: M of its frame. class_ids: [M] int32. title: file name before the
    suffix. settings: depth range of the scene. progress: receives (done, total) rendered views of a mesh. Raises
    ``UserError`` if nothing is shown, for an unknown format, or a file that cannot be written.
    """
    exporter = make_exporter(format_name)
    if len(surfels) == 0:
        raise UserError("nothing is shown, so there is nothing to export: show an object, or lower the least opacity.")
    transform = read_transform(config_path.parent)
    frame = Frame.of_run() if transform is None else Frame(*transform)
    views = None
    if exporter.needs_views:
        views = frame.views(training_viewpoints(open_run(config_path), settings, config_path))
    path = _free_path(config_path.parent / "exports", title, exporter.suffix)
    total = 0 if views is None else len(views.cameras)
    exporter.write(
        path, ExportItem(title, frame.surfels(surfels), class_ids, views, on_render=lambda done: progress(done, total))
    )
    return path


def _free_path(folder: Path, title: str, suffix: str) -> Path:
    """Return a path named after ``title`` that is free, with a number if need be."""
    stem = file_name(title)
    names = chain([stem], (f"{stem}_{number}" for number in count(2)))
    return next(path for name in names if not (path := folder / f"{name}.{suffix}").exists())
