"""Export runs: files for other programs, of each object and of the background."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from itertools import chain, count
from pathlib import Path
from typing import Any

from torch import Tensor

from beags_plugin.core.surfels import Surfels
from beags_plugin.export import EXPORTERS
from beags_plugin.export.base import Exporter, make_exporter
from beags_plugin.export.pose_options import PoseOptions
from beags_plugin.labels.class_ids import BACKGROUND
from beags_plugin.objects.clean import cleaner_of
from beags_plugin.objects.export_job import ExportJob, Progress, Steps
from beags_plugin.objects.exported import Exported, ExportedFile
from beags_plugin.objects.extract import (
    empty_objects,
    file_name,
    folder_names,
    objects_with_gaussians,
    said_of_empty,
)
from beags_plugin.objects.pose import metres_per_unit
from beags_plugin.objects.shown import Shown
from beags_plugin.rasterizers.interface import RasterSettings
from beags_plugin.runs.run import Run
from beags_plugin.splat_io.far_worlds import far_world_note, local_origin, unlist, write_origin
from beags_plugin.splat_io.files import whole_file
from beags_plugin.surfaces.item import ExportItem
from beags_plugin.surfaces.mesh_options import MeshOptions
from beags_plugin.surfaces.meshing import open3d_missing
from beags_plugin.system.errors import UserError, check_choice, writing
from beags_plugin.system.reading.text import load_json
from beags_plugin.system.whole_files import remove_unfinished

MANIFEST = "manifest.json"
_LEFT = 10.0  # seconds without a write after which an unfinished file counts as abandoned
WHOLE = "whole scene"  # the name of the file that holds all Gaussians


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
    pose: PoseOptions | None = None,
    closing: MeshOptions | None = None,
    say: Callable[[str], None] = lambda sentence: None,
) -> list[Exported]:
    """Write files of objects of a run.

    config_path: config.yml of a refined (or assigned) run. objects: names. everything: export all objects that have
    Gaussians, then the background without them, which gets no mesh, and a manifest. whole: also export the whole scene
    in one file; alone, it needs no classes. formats: names of exporters. placement: "world", the frame of the input
    poses (the run's own if it has not saved how they were normalised), or "object", the same centred on each object.
    output: folder; ``exports/`` in the run by default. options: format to its exporter's options. progress: receives
    (done, total) files and views that meshes render. data: folder of the scene if it has moved. keep_all: also keep
    Gaussians that do not belong to their object (``cleaning.clean``); the background and the whole scene are never
    cleaned. pose: where objects stand and how large they are. closing: options of the surface by which objects are
    closed where no photo shows them; the background and the whole scene are never closed. say: receives a sentence on
    objects without Gaussians, with ``everything``. Raises ``UserError`` for a mistake, before anything is written.
    """
    run, folder, pose = Run(config_path, data), output or config_path.parent / "exports", pose or PoseOptions()
    check_choice(placement, ("world", "object"), "frame")
    if pose.centre and placement == "object":
        raise UserError("--centre puts the origin under objects, --frame object into their middle: leave one out.")
    exporters = {name: make_exporter(name, **(options or {}).get(name, {})) for name in formats}
    # Fast formats come first: splats, then formats that render views, then meshes with textures from photos.
    exporters = dict(sorted(exporters.items(), key=lambda named: (named[1].needs_photos, named[1].needs_views)))
    if not exporters:
        raise UserError("no format is named: name one with --format.")
    for name, exporter in exporters.items():
        _check_size(name, exporter, pose, 'with --scale-by, such as "frame_0012:340,215 frame_0012:512,220 12 cm".')
    scene = run.assigned if everything or objects or not whole else run.scene
    present = objects_with_gaussians(scene, objects, run.folder) if scene.assigned else {}
    if everything and objects:
        raise UserError("--all exports every object: leave --object out.")
    if not (everything or objects or whole):
        raise UserError(
            f"nothing to export is named: use --all, --whole, or --object with one of {', '.join(present)}."
        )
    transform, frame, views = run.transform, run.frame, None
    if closing is not None and (reason := open3d_missing()):
        raise UserError(f"objects cannot be closed here: {reason}")
    if closing is not None or any(exporter.needs_views for exporter in exporters.values()):
        views = run.viewpoints
    objects_first = sorted(present, key=lambda name: present[name] == BACKGROUND)
    names = objects_first if everything else list(dict.fromkeys(objects))
    whole_title = file_name(WHOLE)
    titles = folder_names(scene.classes, [whole_title])  # an object may have that name too
    metres = None
    if (length := pose.length()) is not None:
        metres = metres_per_unit(length, run, frame)
    origin = local_origin(*transform) if transform is not None else None
    posed = placement == "object" or pose != PoseOptions()
    shown = Shown(run)
    cleaner = None if keep_all or not any(map(present.get, names)) else cleaner_of(shown)
    job = ExportJob(
        scene, exporters, frame, metres, placement == "object", pose, views, everything, cleaner, shown, closing,
        None if origin is None else frame.centred(origin), None if posed else origin,
    )  # fmt: skip
    items: list[tuple[str, int | None, str]] = [(name, present[name], titles[present[name]]) for name in names]
    if whole:
        items.append((WHOLE, None, whole_title))
    suffixes = [exporter.suffix for exporter in exporters.values()]
    written = {f"{title}.{suffix}" for *_, title in items for suffix in suffixes}
    _clear_up(folder, None if everything else written)
    unlist(folder, written)
    steps = Steps(job.steps(), len(items), progress or (lambda done, total: None))
    exported = [job.export(name, class_id, folder / title, steps) for name, class_id, title in items]
    if job.shift is not None:
        say(_far(folder, job.shift, [file for one in exported for file in one.files if file.path is not None]))
    elif origin is not None and placement == "world" and not pose.centre:
        say(far_world_note(origin, False, False))
    if everything:
        empty = empty_objects(scene, run.folder)
        world = "run" if transform is None else "input"
        content = {
            "run": str(config_path.absolute()),
            "frame": placement,
            "world": world,
            **({} if metres is None else {"unit": "metre", "metres_per_world_unit": metres}),
            "objects": [one.to_json(folder) for one in exported],
            "empty": [{"name": name, "class_id": class_id} for name, class_id in empty.items()],
        }
        with whole_file(folder / MANIFEST) as part:
            part.write_text(json.dumps(content, indent=2), "utf8")
        if empty:
            say(said_of_empty(empty, "exported"))
    return exported


def _far(folder: Path, origin: Tensor, files: Sequence[ExportedFile]) -> str:
    """Write the origin beside the files made around it, and return a sentence on it."""
    others = [file.path.name for file in files if file.path is not None and "origin" in file.facts]
    if others:
        write_origin(folder, origin, others)
    return far_world_note(origin, len(others) < len(files), bool(others))


def _clear_up(folder: Path, names: Set[str] | None) -> None:
    """Remove unfinished files of a killed export from a folder, and a manifest that is about to become wrong.

    names: of the files that will be written; None for those of all objects.
    """
    manifest = folder / MANIFEST
    with writing(folder):
        remove_unfinished(folder, below=False, older=_LEFT, ends=(f".{MANIFEST}", *_ends()))
        if names is None or names & _listed(manifest):
            manifest.unlink(missing_ok=True)


def _ends() -> list[str]:
    """Return the endings of all formats, except those of other packages that cannot be loaded."""
    ends = []
    for name in EXPORTERS.names():
        with suppress(UserError):
            ends.append(f".{EXPORTERS.get(name).suffix}")
    return ends


def _listed(manifest: Path) -> set[str]:
    """Return the files that a manifest lists; empty if it does not exist, or is another program's."""
    try:
        return {file["path"] for one in load_json(manifest)["objects"] for file in one["files"]}
    except (OSError, ValueError, KeyError, TypeError):
        return set()


def export_shown(
    run: Run,
    surfels: Surfels,
    class_ids: Tensor,
    title: str,
    format_name: str,
    settings: RasterSettings,
    progress: Progress = lambda done, total: None,
    scale_by: str = "",
) -> Path:
    """Write the Gaussians that a viewer shows to a new file in ``exports/`` of the run; return its path.

    surfels: M Gaussians in the run's frame. class_ids: [M] int32. title: file name before the suffix. settings: depth
    range of the scene. progress: receives (done, total) rendered views of a mesh. scale_by: see ``PoseOptions``. Raises
    ``UserError`` if nothing is shown, for an unknown format, for a format in millimetres if the scene's size is
    unknown, and for a file that cannot be written.
    """
    exporter, pose = make_exporter(format_name), PoseOptions(scale_by=scale_by)
    _check_size(format_name, exporter, pose, "in the tab Size.")
    if len(surfels) == 0:
        raise UserError("nothing is shown, so there is nothing to export: show an object, or lower the least opacity.")
    frame, origin = run.frame, None if run.transform is None else local_origin(*run.transform)
    if origin is not None:
        frame = frame.centred(origin)
    if (length := pose.length()) is not None:
        given = frame if origin is None else frame.centred(-origin)  # points are given in the world's coordinates
        frame = frame.scaled(metres_per_unit(length, run, given))
    views = None
    if exporter.needs_views:
        views = frame.views(replace(run.viewpoints, settings=settings))
    path = _free_path(run.folder / "exports", title, exporter.suffix)
    total = 0 if views is None else len(views.cameras)
    item = ExportItem(
        title, frame.surfels(surfels), class_ids, views, on_render=lambda done: progress(done, total),
        in_metres=bool(scale_by),
    )  # fmt: skip
    exporter.write(path, item)
    if origin is not None and (scale_by or not exporter.to_world(path, origin)):
        write_origin(path.parent, origin, [path.name])
    return path


def _check_size(name: str, exporter: Exporter, pose: PoseOptions, how: str) -> None:
    """Raise ``UserError`` if a format is in millimetres and the scene's size is unknown. how: to give a length."""
    if exporter.needs_metres and not pose.scale_by:
        raise UserError(
            f"a .{name} file is in millimetres, but the size of the scene is not known: give a length {how}"
        )


def _free_path(folder: Path, title: str, suffix: str) -> Path:
    """Return a free path named ``title``, with a number if needed."""
    stem = file_name(title)
    names = chain([stem], (f"{stem}_{number}" for number in count(2)))
    return next(path for name in names if not (path := folder / f"{name}.{suffix}").exists())
